"""Data sets by name, split into scenes for training, validation and testing."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch.utils.data import Dataset, Subset

from kornia_tidy.checks import check_choice
from kornia_tidy.data.dead_leaves import DeadLeaves
from kornia_tidy.data.flying_things import FOCAL_PX, NEAREST, paper_patches, split_frames
from kornia_tidy.data.nyu_depth import NYUDepthV2
from kornia_tidy.data.patches import central_crop, random_crop
from kornia_tidy.data.photo_collages import PhotoCollages, photographs_in
from kornia_tidy.data.photographic_leaves import PhotographicLeaves
from kornia_tidy.data.remembered import Remembered
from kornia_tidy.data.rgbd_folder import described_folder
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.random_state import seeded
from kornia_tidy.training.settings import TrainingSettings

# Scenes that depend on their number alone (and on the photographs that they show), however many there are.
PAINTED = ("photographic-leaves", "dead-leaves", "photo-collages")
SPLITS = ("train", "validation", "test", "all")
PUBLISHED: dict[str, Literal["train", "val", "test"]] = {"train": "train", "validation": "val", "test": "test"}
SHARE = 10  # one scene in ten is for validation, and one for testing where no split is published
TESTED = 32  # test scenes of dead leaves, unless another number is asked for


def make_scenes(settings: TrainingSettings, split: str, count: int | None = None) -> Dataset[Any]:
    """Return a split of the data set that settings name.

    Args:
        settings: its ``data``, ``root``, ``size``, ``scenes``, ``validation_scenes``, ``depth_range`` and ``seed``.
        split: ``"train"``, ``"validation"`` or ``"test"``; for ``data="rgbd-folder"`` also ``"all"``.
        count: number of scenes of the splits ``"test"`` and ``"all"``, drawn by the seed. None: all of them.

    Returns:
        A map-style data set of ``{"image", "depth", "mask", "index", "name"}``, with depth in metres. Scenes of files
        are cropped to the size: for training at a place drawn from torch's global generator, else in the middle.

    Raises:
        FileNotFoundError: if the data are missing; the message names the download and its folder.
        ValueError: if a name is unknown, the first scene is smaller than the size, or the data cannot be used.

    Example:
        >>> scenes = make_scenes(TrainingSettings(size=32, scenes=3), "train")
        >>> len(scenes), scenes[0]["image"].shape
        (3, torch.Size([3, 32, 32]))
    """
    check_choice("data", settings.data, tuple(SCENES))
    check_choice("split", split, SPLITS if settings.data == "rgbd-folder" else SPLITS[:3])
    if count is not None and count < 1:
        raise ValueError(f"the number of scenes must be 1 or more, got {count}")
    scenes = SCENES[settings.data](settings, split, count)
    with seeded(0):
        scenes[0]  # raises before training if scenes are too small; most data sets have one size
    return scenes


def _painted(settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    counts = {"train": settings.scenes, "validation": settings.validation_scenes, "test": count or TESTED}
    size, seed = (counts[split], settings.size, settings.size), keyed_seed(settings.seed, split)
    depths = settings.depth_range or (0.3, math.inf)
    scenes: Dataset[Any]
    if settings.data == "photo-collages":
        scenes = PhotoCollages(_photographs(settings, split), *size, depth_range=depths, seed=seed)
    else:
        kind = PhotographicLeaves if settings.data == "photographic-leaves" else DeadLeaves
        scenes = kind(*size, depth_range=depths, seed=seed)
    return scenes if settings.fixed_optics else Remembered(scenes)  # captures are remembered in files


def _photographs(settings: TrainingSettings, split: str) -> list[Path]:
    """A tenth of the photographs for validation and a tenth for testing, drawn by the seed."""
    found = photographs_in(_root(settings))
    return [found[place] for place in _order(len(found), settings.seed)[_tenths(len(found), split, _root(settings))]]


def _flying_things(settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    """Frames without metric scale: they are scaled so that the nearest objects lie at the near end of the range."""
    baseline = settings.camera().depth_range[0] * NEAREST / FOCAL_PX
    frames = split_frames(_root(settings), PUBLISHED[split], baseline_m=baseline, transform=_Cut.of(settings, split))
    return _limited(frames, settings, split, count)


def _flying_things_patches(settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    """The paper's patches: normalised disparity 0 to 1 is the far to the near end of the camera's range."""
    cut = _Cut.of(settings, split)._replace(camera=settings.camera())
    options: dict[str, Any] = {"seed": settings.seed, "transform": cut}
    if split == "train":
        options["count"] = settings.scenes
    return _limited(paper_patches(_root(settings), PUBLISHED[split], **options), settings, split, count)


def _nyu(settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    """Validation takes every tenth block of consecutive training frames, as neighbouring frames show one room."""
    published = "test" if split == "test" else "train"
    frames = NYUDepthV2(_root(settings), published, transform=_Cut.of(settings, split))
    if split == "test":
        return _limited(frames, settings, split, count)
    run = max(1, len(frames) // SHARE**2)
    held_out = [i for i in range(len(frames)) if i // run % SHARE == SHARE - 1] or [len(frames) - 1]
    kept = sorted(set(range(len(frames))) - set(held_out))
    return _limited(Subset(frames, kept if split == "train" else held_out), settings, split, count)


def _rgbd_folder(settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    """A tenth of the pairs for validation and a tenth for testing, drawn by the seed."""
    pairs = described_folder(_root(settings), _Cut.of(settings, split))
    if split == "all":
        return _limited(pairs, settings, split, count)
    own = _order(len(pairs), settings.seed)[_tenths(len(pairs), split, _root(settings))]
    return _limited(Subset(pairs, own), settings, split, count)


def _tenths(count: int, split: str, root: Path) -> slice:
    """Return which of shuffled scenes or photographs belong to a split."""
    part = max(1, count // SHARE)
    if count < 3:
        raise ValueError(f"{root} has {count} scenes: 3 or more are needed to train, validate and test")
    return slice(*{"validation": (0, part), "test": (part, 2 * part), "train": (2 * part, count)}[split])


Maker = Callable[[TrainingSettings, str, int | None], Dataset[Any]]
SCENES: dict[str, Maker] = {
    "photographic-leaves": _painted,
    "dead-leaves": _painted,
    "photo-collages": _painted,
    "flying-things": _flying_things,
    "flying-things-patches": _flying_things_patches,
    "nyu": _nyu,
    "rgbd-folder": _rgbd_folder,
}


class _Cut(NamedTuple):
    """Crops a scene, at random or in the middle; with a camera, converts normalised disparity to metres."""

    size: int
    at_random: bool
    camera: ThinLensCamera | None = None

    @classmethod
    def of(cls, settings: TrainingSettings, split: str) -> _Cut:
        return cls(settings.size, split == "train")

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        height, width = sample["image"].shape[-2:]
        if min(height, width) < self.size:
            raise ValueError(
                f"{sample['name']} has {height} x {width} pixels: choose a size of {min(height, width)} or less, not "
                f"{self.size}"
            )
        sample = (random_crop if self.at_random else central_crop)(sample, self.size)
        return sample if self.camera is None else {**sample, "depth": metres(self.camera, sample["depth"])}


def _root(settings: TrainingSettings) -> Path:
    return Path("data", settings.data) if settings.root is None else Path(settings.root)


def _limited(scenes: Any, settings: TrainingSettings, split: str, count: int | None) -> Dataset[Any]:
    """Return at most the wanted number of scenes, drawn by the seed."""
    if not len(scenes):
        raise ValueError(f"{_root(settings)} has no scenes for the split {split!r}")
    limit = {"train": None, "validation": settings.validation_scenes}.get(split, count)
    if limit is not None and limit < len(scenes):
        scenes = Subset(scenes, sorted(_order(len(scenes), settings.seed)[:limit]))
    return scenes


def _order(count: int, seed: int) -> list[int]:
    return torch.randperm(count, generator=torch.Generator().manual_seed(keyed_seed(seed, "split"))).tolist()
