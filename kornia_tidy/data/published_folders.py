"""Published RGB-D data sets in folders: their patterns of names, and how they store depth."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch

from kornia_tidy.data.depth_files import ray_cosine
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.data.rgbd_folder import RGBDFolder
from kornia_tidy.data.scene_dataset import Transform
from kornia_tidy.files import check_folder, find_files

HYPERSIM_FOCAL_PX, HYPERSIM_SIZE = 886.81, (768, 1024)  # of all its images as published


def middlebury(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the stereo scenes of Middlebury from 2014 and 2021, with depth in metres by the calibration of each.

    Args:
        root: folder of folders such as ``Motorcycle-perfect`` with ``im0.png``, ``disp0.pfm`` or, as in the evaluation
            sets, ``disp0GT.pfm``, and ``calib.txt``.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder is missing, or holds no data of this layout.
        ValueError: if an image has no depth, or depth no image.

    Convention:
        Infinite disparity is unknown. Disparity is not valid at pixels that the right camera does not see, unless the
        file tells it.

    Source: Scharstein et al., High-Resolution Stereo Datasets with Subpixel-Accurate Ground Truth (GCPR 2014).
    """
    layouts = [("*/im0.png", "*/disp0.pfm"), ("*/im0.png", "*/disp0GT.pfm")]
    return _folder("Middlebury", root, layouts, transform, kind="disparity", calibration="*/calib.txt")


def seven_scenes(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the frames of 7-Scenes; depth is in millimetres, and 0 and 65535 are unknown.

    Args:
        root: folder of a scene, with ``seq-01/frame-000000.color.png`` and ``.depth.png``, or of a sequence.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder is missing, or holds no data of this layout.
        ValueError: if an image has no depth, or depth no image.

    Convention:
        Image and depth are of two cameras, and are not aligned in the published files.

    Source: Shotton et al., Scene Coordinate Regression Forests (CVPR 2013).
    """
    names = [("frame-*.color.png", "frame-*.depth.png"), ("frame-*.color.jpg", "frame-*.depth.png")]
    layouts = [(f"*/{image}", f"*/{depth}") for image, depth in names] + names
    return _folder("7-Scenes", root, layouts, transform, scale=0.001, invalid=[65535])


def scannet(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the frames of ScanNet, exported from its ``.sens`` files; depth is in millimetres, 0 and 65535 unknown.

    Args:
        root: folder of scans, with ``scene0000_00/color/0.jpg`` and ``scene0000_00/depth/0.png``, or of one scan.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder is missing, or holds no data of this layout.
        ValueError: if an image has no depth, or depth no image.

    Convention:
        Images, 1296 x 968, are averaged to the size of the depth, 640 x 480. Frames are in the order of their names as
        text: 10 comes before 2.

    Source: Dai et al., ScanNet (CVPR 2017).
    """
    layouts = [("*/color/*.jpg", "*/depth/*.png"), ("color/*.jpg", "depth/*.png")]
    return _folder("ScanNet", root, layouts, transform, scale=0.001, invalid=[65535], resample="image")


def kitti(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the selected validation frames of KITTI's depth benchmark, with sparse depth filled along image edges.

    Args:
        root: the folder ``val_selection_cropped``, with ``image`` and ``groundtruth_depth``.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder is missing, or holds no data of this layout.
        ValueError: if an image has no depth, or depth no image.

    Convention:
        Stored values are metres times 256, and 0 is unknown. The mask is True where the laser measured. Everything
        else is filled, see :func:`~kornia_tidy.data.guided_fill.fill_guided`; the sky above the laser's reach gets the
        depth of the pixels below it.

    Source: Uhrig et al., Sparsity Invariant CNNs (3DV 2017).
    """
    layouts = [("image/*_image_*_image_*.png", "groundtruth_depth/*_groundtruth_depth_*_image_*.png")]
    return _folder("KITTI", root, layouts, transform, scale=1 / 256, fill="guided")


def hypersim(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the frames of Hypersim; the stored distance along the ray is converted to depth.

    It needs ``pip install 'kornia-tidy[data]'``.

    Args:
        root: folder of scenes, with ``ai_001_001/images/scene_cam_00_final_preview/frame.0000.tonemap.jpg`` and
            ``ai_001_001/images/scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5``.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder is missing, or holds no data of this layout.
        ValueError: if an image has no depth, or depth no image; on reading, if the sides of a frame are not 4 : 3.

    Convention:
        NaN, such as a window, is unknown. The focal length is 886.81 px at the published width of 1024 px, and in
        proportion in frames that were resized. Cropped frames are refused: where their optical axis is cannot be known.
        Some scenes have tilted lenses, for which this is an approximation.

    Source: Roberts et al., Hypersim (ICCV 2021).
    """
    folder = "*/images/scene_*"
    layouts = [(f"{folder}_final_preview/frame.*.tonemap.jpg", f"{folder}_geometry_hdf5/frame.*.depth_meters.hdf5")]
    return _folder("Hypersim", root, layouts, transform, made=_Hypersim)


class _Hypersim(RGBDFolder):
    """Frames with a stored distance along the ray, which is converted to depth."""

    def read(self, index: int) -> Scene:
        """Read a pair."""
        scene = super().read(index)
        rows, columns = scene.depth.shape[1:]
        scale = columns / HYPERSIM_SIZE[1]
        if abs(rows - scale * HYPERSIM_SIZE[0]) > 1:
            raise ValueError(f"a frame of Hypersim must have sides of 4 : 3, got {rows} rows x {columns} columns")
        cosine = torch.from_numpy(ray_cosine((rows, columns), HYPERSIM_FOCAL_PX * scale))
        return scene._replace(depth=(scene.depth * cosine).float())


def _folder(
    name: str,
    root: str | os.PathLike[str],
    layouts: Sequence[tuple[str, str]],
    transform: Transform | None,
    made: type[RGBDFolder] = RGBDFolder,
    **options: Any,
) -> RGBDFolder:
    """Return the pairs of the first layout that files in the folder have."""
    root = check_folder(root)
    for image, depth in layouts:
        if any(find_files(root, image)) and any(find_files(root, depth)):
            return made(root, image, depth, transform=transform, **options)
    wanted = " or ".join(f"{image} with {depth}" for image, depth in layouts)
    raise FileNotFoundError(f"{name} is not in {root}: there should be {wanted}")
