"""Augmentations and adapters: the camera as a part of kornia, torchvision, albumentations and deepinv.

Read ``random_tidy_optics.py`` first: the camera with settings drawn for each image. ``optics_pipeline.py`` puts it
between geometric and photometric augmentations; ``depth_augmentation.py`` says how depth reaches it in kornia's own
containers. The adapters of other libraries are imported by name: ``torchvision_v2``, ``albumentations_v2`` and
``deepinv_physics``. ``arrays.py`` takes captures of NumPy arrays in one call, as OpenCV has them.
"""

from kornia_tidy.augmentation.depth_augmentation import DepthAugmentation, DepthTap, bound_depth
from kornia_tidy.augmentation.depth_blur import DepthBlur, RandomDepthBlur, depth_blur
from kornia_tidy.augmentation.linear_camera import LinearCamera
from kornia_tidy.augmentation.optics_pipeline import OpticsPipeline
from kornia_tidy.augmentation.random_tidy_optics import RandomTiDyOptics
from kornia_tidy.augmentation.scene_geometry import Scene, SceneGeometry
from kornia_tidy.augmentation.sensor_noise import RandomSensorNoise, sensor_noise

__all__ = [
    "DepthAugmentation",
    "DepthBlur",
    "DepthTap",
    "LinearCamera",
    "OpticsPipeline",
    "RandomDepthBlur",
    "RandomSensorNoise",
    "RandomTiDyOptics",
    "Scene",
    "SceneGeometry",
    "bound_depth",
    "depth_blur",
    "sensor_noise",
]
