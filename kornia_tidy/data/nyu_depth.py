"""NYU Depth v2: 1449 labelled indoor frames of a Kinect, from the published MATLAB file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from kornia_tidy.checks import check_choice
from kornia_tidy.data.hdf5 import DAMAGE, stored_numbers
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.files import error_prefix
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.search_path import import_extra, import_installed

LABELED, SPLITS = "nyu_depth_v2_labeled.mat", "splits.mat"
SOURCES = {
    LABELED: "https://horatio.cs.nyu.edu/mit/silberman/nyu_depth_v2/nyu_depth_v2_labeled.mat (2.8 GB)",
    SPLITS: "https://horatio.cs.nyu.edu/mit/silberman/indoor_seg_sup/splits.mat",
}
LARGEST_SPLITS = 1 << 16  # bytes; a compressed file may hold a thousand times as many
FRAME = (480, 640)
INSIDE = slice(44, 471), slice(40, 601)  # rows and columns that the toolbox evaluates, MATLAB's 45:471 and 41:601


class NYUDepthV2(SceneDataset):
    """Labelled frames of NYU Depth v2 with depth in metres. They need ``pip install 'kornia-tidy[data]'``.

    Args:
        root: the folder that holds ``nyu_depth_v2_labeled.mat`` and ``splits.mat``, as published.
        split: ``"train"`` (795 frames) or ``"test"`` (654) by ``splits.mat``, or ``"all"``.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        FileNotFoundError: if the data are missing; the message names the download and its folder.
        ImportError: if h5py is missing.
        ValueError: if a file is damaged or has other contents.

    Convention:
        - Depth is the published one, whose holes were filled by colour (Levin et al.), on the 427x561 pixels on which
          methods are evaluated, without the white border.
        - A name is the published number of the frame, from ``"0001"`` to ``"1449"``.
        - The file is opened and closed for each item, as an open HDF5 file does not survive a fork. This takes 0.5 ms
          of the 10 ms for an item.

    Source: Silberman et al., Indoor Segmentation and Support Inference from RGBD Images, ECCV 2012.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        split: Literal["train", "test", "all"] = "train",
        *,
        transform: Transform | None = None,
    ) -> None:
        super().__init__(transform)
        self.path = _published(Path(root), LABELED)
        check_choice("split", split, ("train", "test", "all"))
        count = self._count()
        whole = split == "all"
        self.numbers = range(1, count + 1) if whole else _read_split(_published(self.path.parent, SPLITS), split)
        self.names = [f"{number:04d}" for number in self.numbers]
        outside = [number for number in self.numbers if not 1 <= number <= count]
        if outside:
            raise ValueError(f"split {split} names frame {outside[0]}, and {self.path} has frames 1 to {count}")

    def read(self, index: int) -> Scene:
        """Read a frame."""
        row = self.numbers[index] - 1
        with _open(self.path) as file, error_prefix(f"cannot read {self.path}", *DAMAGE):
            image, depth = file["images"][row], file["depths"][row]
        # MATLAB stores columns, HDF5 rows: (480, 640, 3) is read as (3, 640, 480).
        image, depth = image.transpose(0, 2, 1)[:, *INSIDE], np.ascontiguousarray(depth.T[INSIDE], np.float32)
        if not (depth > 0).any():  # False for NaN too
            raise ValueError(f"cannot read {self.path}: the frame has no valid depth at any pixel")
        filled, known = fill_holes(depth)
        return Scene(
            torch.from_numpy(np.ascontiguousarray(image, np.float32) / np.float32(255)),
            torch.from_numpy(filled)[None],
            torch.from_numpy(known)[None],
        )

    def _count(self) -> int:
        """Return the number of frames; raise ``ValueError`` if images or depths are missing or of another shape."""
        with _open(self.path) as file, error_prefix(f"cannot read {self.path}", *DAMAGE):
            shapes = {key: getattr(stored_numbers(file, key), "shape", None) for key in ("images", "depths")}
        images = shapes["images"]
        count = images[0] if images else 0
        height, width = FRAME
        wanted = {"images": (count, 3, width, height), "depths": (count, width, height)}
        if shapes != wanted or not count:
            raise ValueError(f"cannot read {self.path}: it should hold {wanted} (N first), found {shapes}")
        return count


def _published(root: Path, name: str) -> Path:
    """Return the path of a published file; if it is missing, raise an error with its source."""
    if not (root / name).is_file():
        raise FileNotFoundError(f"NYU Depth v2 is not in {root}: download {SOURCES[name]} and keep it as {root / name}")
    return root / name


def _open(path: Path) -> Any:
    h5py = import_extra("h5py", "NYU Depth v2")  # slow to import
    try:
        return h5py.File(path, "r")
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(
            f"cannot read {path}: it is not a MATLAB 7.3 (HDF5) file, or it is damaged: {error}"
        ) from error


def _read_split(path: Path, split: str) -> list[int]:
    key = f"{split}Ndxs"
    loadmat = import_installed("scipy.io").loadmat  # only this needs it
    if path.stat().st_size > LARGEST_SPLITS:
        raise ValueError(f"cannot read {path}: it must have at most {LARGEST_SPLITS} bytes, got {path.stat().st_size}")
    try:
        return loadmat(path, variable_names=[key])[key].ravel().astype(int).tolist()
    except Exception as error:  # of any type, for damaged files
        raise ValueError(f"cannot read {path}: it should hold trainNdxs and testNdxs: {error!r}") from error
