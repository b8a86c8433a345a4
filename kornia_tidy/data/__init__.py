"""Scenes with depth: readers for image and depth files, data sets, scenes painted at random, and their statistics.

Files come in, samples of image, depth and validity mask go out. Read ``scene_dataset.py`` first. Raw files (DNG) are
read by ``lab/raw/decoder.py``. Depth of your own with unknown pixels goes through :func:`fill_holes`.
``scene_statistics.py`` has the power spectrum and light of photographs, and how their depths are distributed, for mask
design and the Wiener filter.
"""

from kornia_tidy.arrays import to_opencv
from kornia_tidy.data.dead_leaves import DeadLeaves, dead_leaves
from kornia_tidy.data.depth_files import DepthMap, read_depth, write_depth
from kornia_tidy.data.flying_things import FlyingThings3D, paper_patches, split_frames
from kornia_tidy.data.image_files import read_image, write_image
from kornia_tidy.data.nyu_depth import NYUDepthV2
from kornia_tidy.data.patches import Patches, central_crop, crop, random_crop
from kornia_tidy.data.photo_collages import PhotoCollages, photo_collage, photographs_in
from kornia_tidy.data.photographic_leaves import PhotographicLeaves, photographic_leaves
from kornia_tidy.data.published_folders import hypersim, kitti, middlebury, scannet, seven_scenes
from kornia_tidy.data.rgbd import Scene, read_rgbd
from kornia_tidy.data.rgbd_folder import RGBDFolder, described_folder
from kornia_tidy.data.sample_scenes import sample_scene
from kornia_tidy.data.scene_dataset import SceneDataset, UnreadableItemError
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.data.statistics_measurement import measured_statistics
from kornia_tidy.data.sun_rgbd import SUNRGBD
from kornia_tidy.data.tum_sequence import TUMSequence
from kornia_tidy.optics.holes import fill_holes

__all__ = [
    "PHOTOGRAPHS",
    "SUNRGBD",
    "DeadLeaves",
    "DepthMap",
    "FlyingThings3D",
    "NYUDepthV2",
    "Patches",
    "PhotoCollages",
    "PhotographicLeaves",
    "RGBDFolder",
    "Scene",
    "SceneDataset",
    "SceneStatistics",
    "TUMSequence",
    "UnreadableItemError",
    "central_crop",
    "crop",
    "dead_leaves",
    "described_folder",
    "fill_holes",
    "hypersim",
    "kitti",
    "measured_statistics",
    "middlebury",
    "paper_patches",
    "photo_collage",
    "photographic_leaves",
    "photographs_in",
    "random_crop",
    "read_depth",
    "read_image",
    "read_rgbd",
    "sample_scene",
    "scannet",
    "seven_scenes",
    "split_frames",
    "to_opencv",
    "write_depth",
    "write_image",
]
