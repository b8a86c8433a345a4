"""albumentations: albumentations documentation, Semantic segmentation and additional targets."""

import albumentations as A
import cv2
import numpy as np

from kornia_tidy.augmentation.albumentations_v2 import OpticsTransform  # new

picture = cv2.cvtColor(cv2.imread("scenes/rgb/0.png"), cv2.COLOR_BGR2RGB)
metres = cv2.imread("scenes/depth/0.png", cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
transform = A.Compose(
    [
        A.HorizontalFlip(p=0.5),
        A.RandomCrop(height=48, width=64),
        OpticsTransform(),  # new
        A.RandomBrightnessContrast(p=0.5),
    ],
    additional_targets={"depth": "mask"},
    seed=1,
)
sample = transform(image=picture, mask=(metres > 1).astype(np.uint8), depth=metres)
image, depth = sample["image"], sample["depth"]
