"""kornia: kornia documentation of AugmentationSequential, data_keys=None."""

import kornia.augmentation as K
from scenes_of_user import load

from kornia_tidy.augmentation import OpticsPipeline  # new

images, depths = load()
augment = K.AugmentationSequential(K.RandomHorizontalFlip(), K.RandomAffine(15.0, p=1.0), data_keys=None)
augment = OpticsPipeline(augment)  # new
sample = augment({"image": images, "mask_depth": depths})
image, depth = sample["image"], sample["mask_depth"]
