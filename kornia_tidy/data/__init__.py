"""Scenes with depth: readers for files, and scenes made by the library."""

from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.depth_files import DepthMap, read_depth, write_depth
from kornia_tidy.data.image_files import read_image, write_image
from kornia_tidy.data.rgbd import Scene, read_rgbd

__all__ = ["DepthMap", "Scene", "dead_leaves", "read_depth", "read_image", "read_rgbd", "write_depth", "write_image"]
