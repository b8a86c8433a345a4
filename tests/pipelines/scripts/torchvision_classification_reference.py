"""torchvision: torchvision references/classification/presets.py; no depth: a flat scene at 0.8 m."""

import torch
from torch.utils.data import DataLoader
from torchvision.datasets import ImageFolder
from torchvision.transforms import v2

from kornia_tidy import TiDyOptics  # new

transforms = [v2.ToImage(), v2.ToDtype(torch.float32, scale=True), v2.RandomResizedCrop((48, 64))]
transforms += [v2.Lambda(lambda image: TiDyOptics()(image, torch.full_like(image[:1], 0.8)).detach())]  # new
transforms += [v2.Normalize([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])]
loader = DataLoader(ImageFolder("scenes", v2.Compose(transforms), allow_empty=True), batch_size=3)
image, label = next(iter(loader))
