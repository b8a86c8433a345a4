"""Augmentations and adapters: the camera as a part of kornia, torchvision, albumentations and deepinv.

``arrays.py`` takes captures of NumPy arrays in one call, as OpenCV has them.
"""
