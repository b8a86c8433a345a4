"""OpenCV: OpenCV-Python tutorials, Smoothing images."""

import cv2

import kornia_tidy  # new

image = cv2.imread("scenes/rgb/0.png")
depth = cv2.imread("scenes/depth/0.png", cv2.IMREAD_UNCHANGED)
image = kornia_tidy.simulate(image, depth, depth_scale=0.001)  # new
cv2.imwrite("out.png", cv2.GaussianBlur(image, (3, 3), 0))
