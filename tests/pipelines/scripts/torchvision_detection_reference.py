"""torchvision: torchvision references/detection/presets.py, the SSD preset."""

import torch
from scenes_of_user import load
from torchvision import tv_tensors
from torchvision.transforms import v2

from kornia_tidy.augmentation.torchvision_v2 import Depth, OpticsTransform  # new

images, depths = load()
boxes = tv_tensors.BoundingBoxes([[4, 4, 30, 40]], format="XYXY", canvas_size=images.shape[-2:])
# was: target = {"boxes": boxes, "labels": torch.tensor([1]), "depth": tv_tensors.Mask(depths[0])}
target = {"boxes": boxes, "labels": torch.tensor([1]), "depth": Depth(depths[0])}
transforms = [v2.ToImage(), v2.RandomZoomOut(p=1.0, side_range=(1.1, 1.3)), v2.RandomHorizontalFlip(0.5)]
transforms += [v2.SanitizeBoundingBoxes(), v2.ToDtype(torch.float32, scale=True)]
transforms += [OpticsTransform(holes="fill")]  # new
image, target = v2.Compose(transforms)(tv_tensors.Image(images[0]), target)
depth = target["depth"]
