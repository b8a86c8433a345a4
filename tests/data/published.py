"""Small data sets in the published formats, written without the library's own writers."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

HEADER_7_3 = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Sun Oct 14 19:14:16 2012 HDF5 schema 1.00 ."


def write_pfm(path: Path, values: NDArray[np.float32]) -> None:
    """As FlyingThings3D has it: a blank before the end of the first lines, rows from bottom to top."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = values.shape
    path.write_bytes(f"Pf \n{width} {height}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes())


def write_flying_things(
    root: Path,
    sequences: dict[str, int],
    *,
    frames: str = "frames_cleanpass",
    suffix: str = ".png",
    size: tuple[int, int] = (12, 20),
) -> None:
    """Write as many sequences of two frames as said for each part, 'TRAIN/A': left and right, images and disparity.

    The red channel of an image is 8 times the disparity, so that both tell which frame they are and what is where.
    """
    number = 0
    for part, count in sequences.items():
        for sequence in range(count):
            for view in ("left", "right"):
                for frame in ("0006", "0007"):
                    name = f"{part}/{sequence:04d}/{view}/{frame}"
                    disparity = flying_things_disparity(number, size)
                    image = np.zeros((*size, 3), np.uint8)
                    image[..., 2] = 8 * disparity  # OpenCV's order is blue, green, red
                    path = root / frames / f"{name}{suffix}"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []  # above 100: lossless
                    assert cv2.imwrite(str(path), image, options)
                    write_pfm(root / "disparity" / f"{name}.pfm", disparity)
                    number += 1


def write_frames(root: Path, image: str, depth: str, count: int = 3) -> None:
    """Write frames of noise whose paths have the number of the frame in the place of {}."""
    rng = np.random.default_rng(0)
    for number in range(count):
        for pattern, values in (
            (image, rng.integers(0, 255, (36, 44, 3), np.uint8)),
            (depth, rng.integers(0, 65535, (36, 44), np.uint16)),
        ):
            path = root / pattern.format(number)
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), values)


def flying_things_disparity(number: int, size: tuple[int, int] = (12, 20)) -> NDArray[np.float32]:
    """Whole pixels from 1 to 31, different for each file written, and not symmetric in any way."""
    rows, columns = np.indices(size)
    return (1 + (7 * number + 3 * rows + 5 * columns + rows * columns) % 31).astype(np.float32)


def write_nyu(root: Path, count: int = 5) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Write the labelled set and its split; returns MATLAB's images (H, W, 3, N), depths and rawDepths (H, W, N)."""
    rng = np.random.default_rng(0)
    images = np.kron(rng.integers(0, 255, (24, 32, 3, count), np.uint8), np.ones((20, 20, 1, 1), np.uint8))
    depths = np.kron(rng.uniform(0.7, 9.9, (24, 32, count)).astype(np.float32), np.ones((20, 20, 1), np.float32))
    raw = depths.copy()
    raw[100:130, 200:260] = 0
    with h5py.File(root / "nyu_depth_v2_labeled.mat", "w", userblock_size=512) as file:
        for key, values in {"images": images, "depths": depths, "rawDepths": raw}.items():
            columns_first = values.transpose()  # HDF5 keeps rows together, MATLAB columns: every axis is turned round
            data = file.create_dataset(
                key, data=columns_first, chunks=(1, *columns_first.shape[1:]), compression="gzip"
            )
            data.attrs["MATLAB_class"] = np.bytes_(values.dtype.name.replace("float32", "single"))
    with (root / "nyu_depth_v2_labeled.mat").open("r+b") as file:
        file.write(HEADER_7_3.ljust(116) + bytes(8) + b"\x00\x02IM")
    half = np.arange(1, count + 1, dtype=np.uint16)
    savemat(root / "splits.mat", {"trainNdxs": half[1::2, None], "testNdxs": half[::2, None]}, do_compression=True)
    return images, depths, raw


def write_each(root: Path) -> None:
    """Write one or two scenes of each data set, in folders named as in docs/data_sets.md."""
    (root / "nyu").mkdir()
    write_nyu(root / "nyu", 2)
    parts = {f"{half}/{part}": 1 for half in ("TRAIN", "TEST") for part in "ABC"}
    write_flying_things(root / "flyingthings3d", {**parts, "TRAIN/A": 8}, size=(279, 280))
    write_frames(root / "chess", "seq-01/frame-{:06}.color.png", "seq-01/frame-{:06}.depth.png", 1)
    write_frames(root / "scans", "scene0000_00/color/{}.jpg", "scene0000_00/depth/{}.png", 1)
    write_frames(root / "SUNRGBD/kv2", "{}/image/a.jpg", "{}/depth_bfx/a.png", 1)
    drive = "2011_09_26_drive_0002_sync"
    names = (
        f"image/{drive}_image_{{:010}}_image_02.png",
        f"groundtruth_depth/{drive}_groundtruth_depth_{{:010}}_image_02.png",
    )
    write_frames(root / "val_selection_cropped", *names, 1)
    write_frames(root / "rgbd_dataset_freiburg1_desk", "rgb/{}.0.png", "depth/{}.0.png", 1)
    for part in ("rgb", "depth"):
        (root / "rgbd_dataset_freiburg1_desk" / f"{part}.txt").write_text(f"0.0 {part}/0.0.png\n")
    write_frames(root / "middlebury2014", "Piano{}/im0.png", "unused/{}.png", 1)
    write_pfm(root / "middlebury2014/Piano0/disp0.pfm", np.full((36, 44), 48.0, np.float32))
    calibration = "cam0=[1000 0 4; 0 1000 3; 0 0 1]\ndoffs=2\nbaseline=100\nwidth=44\nheight=36\n"
    (root / "middlebury2014/Piano0/calib.txt").write_text(calibration)
    preview, geometry = (f"ai_001_001/images/scene_cam_00_{kind}" for kind in ("final_preview", "geometry_hdf5"))
    write_frames(root / "hypersim", preview + "/frame.{:04}.tonemap.jpg", "unused/{}.png", 1)
    (root / "hypersim" / geometry).mkdir()
    with h5py.File(root / "hypersim" / geometry / "frame.0000.depth_meters.hdf5", "w") as file:
        file.create_dataset("dataset", data=np.full((36, 44), 3.0, np.float16))
