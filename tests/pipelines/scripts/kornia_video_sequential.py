"""kornia: kornia documentation of VideoSequential."""

import kornia.augmentation as K
from scenes_of_user import load

from kornia_tidy import TiDyOptics  # new

images, depth = load()
clip = images[None]  # (B, T, C, H, W)
clip = TiDyOptics()(clip.flatten(0, 1), depth).reshape(clip.shape)  # new
augment = K.VideoSequential(K.ColorJiggle(0.1, 0.1, p=1.0), data_format="BTCHW", same_on_frame=True)
image = augment(clip)[0]
