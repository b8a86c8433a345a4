"""albumentations: albumentations example, PyTorch semantic segmentation (ToTensorV2 in a data set)."""

import albumentations as A
import cv2
import numpy as np
from albumentations.pytorch import ToTensorV2
from torch.utils.data import DataLoader, Dataset

from kornia_tidy.augmentation.albumentations_v2 import OpticsTransform  # new


class Scenes(Dataset):
    def __init__(self, transform):
        self.transform = transform

    def __len__(self):
        return 3

    def __getitem__(self, index):
        picture = cv2.imread(f"scenes/rgb/{index}.png")[:, :, ::-1]
        metres = cv2.imread(f"scenes/depth/{index}.png", cv2.IMREAD_UNCHANGED) / np.float32(1000)
        return self.transform(image=np.ascontiguousarray(picture), depth=metres)


steps = [A.Affine(rotate=(-10, 10), p=1.0), A.Normalize(), ToTensorV2()]
steps.insert(1, OpticsTransform(holes="fill"))  # new
targets = {"depth": "mask"}
targets["valid"] = "mask"  # new
batch = next(iter(DataLoader(Scenes(A.Compose(steps, additional_targets=targets, seed=1)))))
image, depth = batch["image"], batch["depth"][:, None]
