"""FlyingThings3D: synthetic stereo frames with exact disparity, as whole frames or as patches like the paper's."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal

from torch.utils.data import Subset

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.data.patches import Patches
from kornia_tidy.data.rgbd import Scene, read_rgbd
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.files import find_files

FRAMES = "frames_cleanpass"
FOCAL_PX = 1050.0  # 35 mm on a sensor 32 mm and 960 pixels wide
NEAREST = 160.0  # px of disparity; values found range from 1.1 to 152
SOURCE = "https://lmb.informatik.uni-freiburg.de/resources/datasets/SceneFlowDatasets.en.html"

PATCH_SIZE = 278  # px; 256 of them lie half a PSF of 23 pixels or more from the border
PATCH_COUNTS = {"train": 5077, "val": 553, "test": 419}
HELD_OUT = 10  # every tenth sequence of TRAIN is for validation, as 553 of 5630 patches are in the paper


class FlyingThings3D(SceneDataset):
    r"""Frames of FlyingThings3D, with depth :math:`z = f B / d` from disparity d or with normalised disparity.

    Args:
        root: the folder that holds ``frames_cleanpass`` (PNG) or ``frames_cleanpass_webp``, and ``disparity``, as
            published.
        split: the published split; its parts share no object and no texture.
        baseline_m: B, assumed distance between the two cameras in metres. Default: 1.
        disparity_range: (far, near) in pixels: depth is then the disparity, scaled to 0 at far and 1 at near,
            for a camera of :class:`~kornia_tidy.DefocusRange`. Disparities outside are clamped, and False in the
            mask.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        FileNotFoundError: if the data are missing; the message names the download and its folder.
        ValueError: if frames have no disparity, or an argument is not as above.

    Convention:
        - Frames are those of the left camera, sharp everywhere, of the parts A, B and C that are there.
        - The data have no metric scale: the cameras are 1 unit apart. With a unit of one metre the median disparities
          of the frames examined (26 to 46 pixels) are 23 to 40 m; with ``baseline_m=0.05`` they are 1.1 to 2.0 m.
        - A name is the published path without its suffix, ``"TRAIN/A/0000/left/0006"``.

    Source: Mayer et al., A Large Dataset to Train Convolutional Networks for Disparity, Optical Flow, and Scene Flow
    Estimation, CVPR 2016.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        split: Literal["train", "test"] = "train",
        *,
        baseline_m: float | None = None,
        disparity_range: tuple[float, float] | None = None,
        transform: Transform | None = None,
    ) -> None:
        super().__init__(transform)
        check_choice("split", split, ("train", "test"))
        if disparity_range is not None:
            _check_disparity_range(disparity_range, baseline_m)
        self.baseline_m = 1.0 if baseline_m is None else baseline_m
        check_positive("baseline_m", self.baseline_m, "metres")
        self.root = Path(root)
        self.disparity_range = disparity_range
        self.folder, self.suffix = _frames_folder(self.root)
        self.names = _list_names(self.folder, split.upper(), self.suffix)
        if not self.names:
            raise FileNotFoundError(f"{self.folder} has no left frames *{self.suffix} of {split.upper()}")
        self._check_disparities(split.upper())

    def read(self, index: int) -> Scene:
        """Read a frame and its disparity."""
        name = self.names[index]
        image = self.folder / f"{name}{self.suffix}"
        disparity = self.root / "disparity" / f"{name}.pfm"
        if self.disparity_range is None:
            return read_rgbd(image, disparity, kind="disparity", focal_px=FOCAL_PX, baseline_m=self.baseline_m)
        scene = read_rgbd(image, disparity, kind="disparity", focal_px=1.0, baseline_m=1.0)
        far, near = self.disparity_range
        level = (1 / scene.depth - far) / (near - far)
        return Scene(scene.image, level.clamp(0, 1), scene.valid & (level >= 0) & (level <= 1))

    def _check_disparities(self, part: str) -> None:
        """Raise ``ValueError`` if a frame has no disparity file."""
        disparity = self.root / "disparity"
        known = set(_list_names(disparity, part, ".pfm"))
        if unpaired := [name for name in self.names if name not in known]:
            raise ValueError(
                f"{len(unpaired)} of {len(self.names)} frames have no disparity, the first is {unpaired[0]}: "
                f"there is no {disparity / unpaired[0]}.pfm"
            )


def split_frames(
    root: str | os.PathLike[str], split: Literal["train", "val", "test"] = "train", **options: Any
) -> Subset[Any]:
    """Return a split of FlyingThings3D in which every tenth sequence of the published TRAIN is for validation.

    Args:
        root: see :class:`FlyingThings3D`.
        split: training and validation are from different sequences of the published TRAIN, testing from TEST.
        **options: passed on to :class:`FlyingThings3D`.

    Raises:
        FileNotFoundError: as :class:`FlyingThings3D`; so is its ``ValueError``.
        ValueError: if there are fewer than ten sequences of TRAIN.
    """
    check_choice("split", split, tuple(PATCH_COUNTS))
    frames = FlyingThings3D(root, "test" if split == "test" else "train", **options)
    if split == "test":
        return Subset(frames, range(len(frames)))
    sequences = sorted({_sequence(name) for name in frames.names})
    held_out = set(sequences[HELD_OUT - 1 :: HELD_OUT])
    if not held_out:
        raise ValueError(f"{root} has {len(sequences)} sequences of TRAIN: {HELD_OUT} or more are needed to validate")
    return Subset(
        frames, [i for i, name in enumerate(frames.names) if (_sequence(name) in held_out) == (split == "val")]
    )


def paper_patches(
    root: str | os.PathLike[str],
    split: Literal["train", "val", "test"] = "train",
    *,
    count: int | None = None,
    disparity_range: tuple[float, float] = (0.0, NEAREST),
    seed: int = 0,
    transform: Transform | None = None,
) -> Patches:
    """Return patches of 278x278 pixels from FlyingThings3D with normalised disparity, like those of the paper.

    The paper uses 5077 patches for training and 419 for testing from an earlier work, which has 553 for validation.
    Neither their frames nor the normalisation of disparity are published. These patches are equal in number, drawn by
    the seed from the left clean frames, so that results are comparable to the paper's but not equal.

    Args:
        root: see :class:`FlyingThings3D`.
        split: training and validation are from different sequences of the published TRAIN, testing from TEST.
        count: number of patches. Default: that of the paper.
        disparity_range: (far, near) in pixels, which become 0 and 1.
        seed: of the choice of frames and places.
        transform: called with each patch.

    Returns:
        A data set for a camera of ``DefocusRange(-20, 20)``.

    Raises:
        FileNotFoundError: if the data are missing; the message names the download and its folder.
        ValueError: if frames have no disparity, or an argument is not as above.

    Source: Wu et al., PhaseCam3D (ICCP 2019), section 3; Shah et al., TiDy-PSFs (ICCV 2023), section 5.
    """
    frames = split_frames(root, split, disparity_range=disparity_range)
    count = PATCH_COUNTS[split] if count is None else count
    return Patches(frames, PATCH_SIZE, count, seed=seed, transform=transform)


def _sequence(name: str) -> str:
    """'TRAIN/A/0000/left/0006' -> 'TRAIN/A/0000'."""
    return name.rsplit("/", 2)[0]


def _check_disparity_range(disparity_range: tuple[float, float], baseline_m: float | None) -> None:
    far, near = disparity_range
    if not (0 <= far < near and math.isfinite(near)):
        raise ValueError(f"disparity_range must be (far, near) in pixels with 0 <= far < near, got {disparity_range}")
    if baseline_m is not None:
        raise ValueError(
            f"normalised disparity has no metres: give disparity_range or baseline_m={baseline_m}, not both"
        )


def _frames_folder(root: Path) -> tuple[Path, str]:
    """Return the folder of the frames and their suffix; PNG is preferred to WebP."""
    for folder, suffix in ((root / FRAMES, ".png"), (root / f"{FRAMES}_webp", ".webp")):
        if folder.is_dir() and (root / "disparity").is_dir():
            return folder, suffix
    raise FileNotFoundError(
        f"FlyingThings3D is not in {root}: download 'RGB images (cleanpass)', as PNG or WebP, and 'Disparity' of "
        f"FlyingThings3D from {SOURCE}, and unpack both there, so that there are "
        f"{root / FRAMES / 'TRAIN/A/0000/left/0006.png'} and "
        f"{root / 'disparity/TRAIN/A/0000/left/0006.pfm'}"
    )


def _list_names(folder: Path, part: str, suffix: str) -> list[str]:
    """Return the published paths in a part, sorted, without suffix; other files than numbered ones are left out."""
    files = find_files(folder / part, f"[ABC]/[0-9]*/left/[0-9]*{suffix}")
    return sorted(file.relative_to(folder).with_suffix("").as_posix() for file in files)
