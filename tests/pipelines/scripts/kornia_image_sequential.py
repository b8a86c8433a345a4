"""kornia: kornia documentation of ImageSequential."""

import kornia.augmentation as K
from scenes_of_user import load

from kornia_tidy import TiDyOptics  # new

images, depth = load()
augment = K.ImageSequential(K.ColorJiggle(0.1, 0.1, 0.1, 0.1, p=1.0), K.RandomGaussianNoise(std=0.01))
images = TiDyOptics()(images, depth)  # new
image = augment(images)
