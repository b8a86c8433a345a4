"""What each script's user has already: a folder of scenes, a data set and a network."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

COUNT, HEIGHT, WIDTH = 3, 64, 80


def load() -> tuple[Tensor, Tensor]:
    """Images and depths in metres, (3, 3, 64, 80) and (3, 1, 64, 80)."""
    images = np.stack([cv2.imread(f"scenes/rgb/{index}.png")[:, :, ::-1] for index in range(COUNT)])
    depths = np.stack([cv2.imread(f"scenes/depth/{index}.png", cv2.IMREAD_UNCHANGED) for index in range(COUNT)])
    return torch.from_numpy(images / np.float32(255)).movedim(-1, 1), torch.from_numpy(depths / np.float32(1e3))[
        :, None
    ]


class Scenes(Dataset):
    """The folder as samples with an index."""

    def __init__(self, transform=None):
        self.transform = transform

    def __len__(self):
        return COUNT

    def __getitem__(self, index):
        images, depths = load()
        sample = {"image": images[index], "depth": depths[index], "index": index}
        return sample if self.transform is None else self.transform(sample)


class Network(nn.Module):
    """Depth from an image."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(), nn.Conv2d(4, 1, 3, padding=1))

    def forward(self, image):
        return self.layers(image)
