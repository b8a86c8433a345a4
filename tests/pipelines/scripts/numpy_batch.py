"""NumPy, OpenCV: a batch of images as a NumPy array, flipped by slices."""

import cv2
import numpy as np

import kornia_tidy  # new

image = np.stack([cv2.imread(f"scenes/rgb/{index}.png") for index in range(3)]).astype(np.float32) / 255
depth = np.stack([cv2.imread(f"scenes/depth/{index}.png", cv2.IMREAD_UNCHANGED) / 1e3 for index in range(3)])
image = kornia_tidy.simulate(image, depth)  # new
image = image[:, :, ::-1]
depth = depth[:, :, ::-1]
