"""torchvision: torchvision gallery, Getting started with transforms v2."""

from scenes_of_user import load
from torchvision.transforms import v2
from torchvision.tv_tensors import Image, Mask

from kornia_tidy.augmentation.torchvision_v2 import Depth, OpticsTransform  # new

images, depths = load()
transform = v2.Compose(
    [
        v2.RandomHorizontalFlip(0.5),
        v2.RandomResizedCrop((48, 64), scale=(0.5, 1.0)),
        OpticsTransform(),  # new
        v2.ColorJitter(0.2, 0.2),
    ]
)
# was: sample = {"image": Image(images[0]), "depth": Mask(depths[0]), "classes": Mask(depths[0] > 1)}
sample = {"image": Image(images[0]), "depth": Depth(depths[0]), "classes": Mask(depths[0] > 1)}
sample = transform(sample)
image, depth = sample["image"], sample["depth"]
assert sample["classes"].shape == depth.shape
