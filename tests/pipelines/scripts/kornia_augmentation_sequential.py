"""kornia: kornia tutorials, Data augmentation: AugmentationSequential with masks."""

import kornia.augmentation as K
from scenes_of_user import load

from kornia_tidy.augmentation import OpticsPipeline  # new

images, depths = load()
augment = K.AugmentationSequential(K.RandomHorizontalFlip(p=0.5), K.RandomCrop((48, 64)), data_keys=["input", "mask"])
augment = OpticsPipeline(augment)  # new
image, depth = augment(images, depths)
