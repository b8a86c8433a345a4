"""Folders of pictures with depth, paired by patterns of file names."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path, PurePath
from typing import Any
from unicodedata import normalize

from kornia_tidy.data.calibration_files import read_calibration
from kornia_tidy.data.depth_files import check_depth_options
from kornia_tidy.data.patches import central_crop
from kornia_tidy.data.rgbd import Scene, check_pairing_options, read_rgbd
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.files import check_folder, find_files, read_json
from kornia_tidy.settings import is_number

ABOUT = "rgbd.json"
KNOWN = ("image", "depth", "scale", "kind", "invalid", "focal_px", "baseline_m", "doffs_px")
KNOWN += ("rotated_bits", "resample", "fill", "calibration")
_TEXTS = ("image", "depth", "kind", "resample", "fill", "calibration")


class RGBDFolder(SceneDataset):
    """Data set of image and depth files in a folder, paired by their names.

    Args:
        root: the folder.
        image: pattern of the images' paths in the folder. Each ``*`` matches one or more characters other than ``/``;
            everything else is literal. Hidden files, whose names begin with a dot, are ignored.
        depth: pattern of the depth files. Image and depth are a pair if every ``*`` matches the same in both.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.
        calibration: pattern of the file with the calibration of each pair, see
            :func:`~kornia_tidy.data.calibration_files.read_calibration`. Its ``*`` take the text that the first ones of
            the pair match; there may be fewer. Its values override ``options``.
        **options: how depth is stored and joined with the image, see :func:`~kornia_tidy.data.rgbd.read_rgbd` and
            :func:`~kornia_tidy.data.depth_files.read_depth`.

    Raises:
        FileNotFoundError: if the folder is missing, no file fits a pattern, or a calibration is missing.
        ValueError: if a file has no partner; if a pattern has no ``*``, another number of them than the other one, or
            leads out of the folder; or if the options contradict each other.

    Convention:
        - Items are sorted by name; a name joins the texts that the ``*`` match by ``/``. Names are compared as text, as
          in torchvision's ``ImageFolder``: ``frame10`` comes before ``frame2``. Number frames with leading zeros where
          their order matters.
        - A file that matches both patterns belongs to the longer one, so that ``"*.png"`` and ``"*_depth.png"`` may lie
          in one folder.

    Example:
        >>> import tempfile, torch
        >>> from kornia_tidy.data.depth_files import write_depth
        >>> from kornia_tidy.data.image_files import write_image
        >>> folder = tempfile.TemporaryDirectory()
        >>> for name in ("lamp", "chair"):
        ...     write_image(f"{folder.name}/{name}.png", torch.rand(3, 4, 6))
        ...     write_depth(f"{folder.name}/{name}_depth.png", torch.full((1, 4, 6), 1.25), scale=0.001)
        >>> scenes = RGBDFolder(folder.name, "*.png", "*_depth.png", scale=0.001)
        >>> len(scenes), scenes[0]["name"], scenes[0]["depth"].unique()
        (2, 'chair', tensor([1.2500]))
        >>> folder.cleanup()
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        image: str,
        depth: str,
        *,
        transform: Transform | None = None,
        calibration: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(transform)
        joined = {key: options[key] for key in ("resample", "fill") if key in options}
        check_pairing_options(**joined)
        if calibration is None:
            stored = {key: value for key, value in options.items() if key != "invalid" and key not in joined}
            check_depth_options(**stored)
        self.root = Path(root)
        self.pairs = _pair(self.root, image, depth)
        self.names = [name for name, _, _ in self.pairs]
        self.options: dict[str, Any] = options
        self.calibrations = None if calibration is None else self._calibrations(calibration)

    def read(self, index: int) -> Scene:
        """Read image and depth of a pair."""
        _, image, depth = self.pairs[index]
        options: dict[str, Any] = self.options
        if self.calibrations is not None:
            calibration: dict[str, Any] = {**read_calibration(self.calibrations[index])}
            options = options | calibration
        return read_rgbd(self.root / image, self.root / depth, **options)

    def _calibrations(self, pattern: str) -> list[Path]:
        """Return the file with the calibration of each pair."""
        _check_within(pattern)
        first, *others = pattern.split("*")
        files = []
        for name, _, _ in self.pairs:
            parts = name.split("/")
            if len(others) > len(parts):
                raise ValueError(
                    f"calibration must have at most {len(parts)} * as the images have, got {pattern!r:.80}"
                )
            files.append(self.root / (first + "".join(map("".join, zip(parts, others, strict=False)))))
            if not files[-1].is_file():
                raise FileNotFoundError(f"there is no {files[-1]}, the calibration of {name}")
        return files


def described_folder(root: str | os.PathLike[str], transform: Transform | None = None) -> RGBDFolder:
    """Return the scenes of a folder by the description in its file ``rgbd.json``.

    Args:
        root: the folder. ``rgbd.json`` in it holds arguments of :class:`RGBDFolder` as JSON, such as
            ``{"image": "*.png", "depth": "*_depth.png", "scale": 0.001}``.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`.

    Raises:
        FileNotFoundError: if the folder or its ``rgbd.json`` is missing, or no file fits a pattern.
        ValueError: if ``rgbd.json`` is not as above, or as :class:`RGBDFolder` does.

    Example:
        >>> import tempfile, torch
        >>> from kornia_tidy.data.depth_files import write_depth
        >>> from kornia_tidy.data.image_files import write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/lamp.png", torch.rand(3, 4, 6))
        ...     write_depth(f"{folder}/lamp_depth.png", torch.full((1, 4, 6), 1.25), scale=0.001)
        ...     _ = Path(folder, "rgbd.json").write_text('{"image": "*.png", "depth": "*_depth.png", "scale": 0.001}')
        ...     described_folder(folder)[0]["depth"].unique()
        tensor([1.2500])
    """
    root = Path(root)
    path = root / ABOUT
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no {path}: it tells which files in the folder are pairs and how depth is stored, such as "
            '{"image": "*.png", "depth": "*_depth.png", "scale": 0.001} for millimetres'
        )
    about = read_json(path)
    if not isinstance(about, dict) or not {"image", "depth"} <= set(about) <= set(KNOWN):
        known = f'it should hold "image" and "depth" and may hold {", ".join(KNOWN[2:])}'
        raise ValueError(f"cannot read {path}: {known}, got {about!s:.80}")
    for name, value in about.items():
        if kind := _other_kind(name, value):
            raise ValueError(f"cannot read {path}: {name} must be {kind}, got {value!r:.80}")
    return RGBDFolder(root, transform=transform, **about)


def scenes_in(root: str | os.PathLike[str], largest: int = 512) -> list[Scene]:
    """Return the scenes of a folder with ``rgbd.json``, of large ones the middle.

    Args:
        root: see :func:`described_folder`.
        largest: pixels along a side.
    """
    scenes = []
    for sample in described_folder(root):
        height, width = sample["image"].shape[-2:]
        cut = central_crop(sample, (min(height, largest), min(width, largest)))
        scenes.append(Scene(cut["image"], cut["depth"], cut["mask"]))
    return scenes


def _other_kind(name: str, value: Any) -> str:
    """Return the kind of an option's values if that of the description is of another one; else an empty text."""
    if name in _TEXTS:
        return "" if isinstance(value, str) else "a text"
    if name == "invalid":
        numbers = isinstance(value, list) and all(is_number(entry) for entry in value)
        return "" if numbers else "a list of numbers"
    return "" if is_number(value) or (value is None and name in {"focal_px", "baseline_m"}) else "a number"


def _pair(root: Path, image: str, depth: str) -> list[tuple[str, str, str]]:
    """Return name, image and depth file of each pair, sorted by name; paths are relative to the root."""
    if image.count("*") != depth.count("*") or "*" not in image:
        raise ValueError(
            f"patterns must have a * and equally many of them, got image={image!r:.80}, depth={depth!r:.80}"
        )
    if image == depth:
        raise ValueError(f"image and depth must have different patterns, got {image!r:.80} for both")
    for pattern in (image, depth):
        _check_within(pattern)
    check_folder(root)
    images, depths = _matches(root, image), _matches(root, depth)
    shared = set(images.values()) & set(depths.values())
    if len(image) < len(depth):
        images = {name: path for name, path in images.items() if path not in shared}
    else:
        depths = {name: path for name, path in depths.items() if path not in shared}
    for kind, pattern, found in (("image", image, images), ("depth file", depth, depths)):
        if not found:
            raise FileNotFoundError(f"no {kind} in {root} fits {pattern!r:.80}")
    unpaired = [images[name] for name in images.keys() - depths.keys()]
    unpaired += [depths[name] for name in depths.keys() - images.keys()]
    if unpaired:
        shown = ", ".join(sorted(unpaired)[:3]) + (", ..." if len(unpaired) > 3 else "")
        raise ValueError(f"{len(unpaired)} files in {root} have no partner by {image!r:.80} and {depth!r:.80}: {shown}")
    return [("/".join(name), images[name], depths[name]) for name in sorted(images)]


def _check_within(pattern: str) -> None:
    """Raise ``ValueError`` if a pattern leads out of the folder."""
    if PurePath(pattern).is_absolute() or ".." in PurePath(pattern).parts or "\0" in pattern:
        raise ValueError(f"patterns must stay within the folder, got {pattern!r:.80}")


def _matches(root: Path, pattern: str) -> dict[tuple[str, ...], str]:
    """Return the files that match a pattern: path relative to the root by the parts that ``*`` matches.

    The parts are composed (NFC): macOS may write the two names of a pair in different forms of Unicode.
    """
    parts = PurePath(pattern).as_posix().split("*")
    fits = re.compile("([^/]+)".join(map(re.escape, parts)))
    pattern = "*".join(map(glob.escape, parts))
    found = (file.relative_to(root).as_posix() for file in find_files(root, pattern))
    matches = (match for match in map(fits.fullmatch, found) if match)
    return {tuple(normalize("NFC", part) for part in match.groups()): match.string for match in matches}
