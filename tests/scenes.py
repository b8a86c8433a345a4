"""The real scenes of ../shared/data, read with the library's own readers."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from kornia_tidy.data import Scene, read_rgbd
from tests.base import DATA, shared

ENTRIES: dict[str, dict[str, Any]] = (
    {entry["name"]: entry for entry in json.loads((DATA / "scenes.json").read_text())}
    if (DATA / "scenes.json").is_file()
    else {}
)

# Stereo sets without calibration get this one: it puts their median disparities (26 to 59 px) at 1.7 to 3.8 m. Shapes
# are then right up to a projective stretch along depth, which is enough to render them; metres mean nothing.
NOMINAL_CALIBRATION = {"focal_px": 1000.0, "baseline_m": 0.1}


def load_scene(name: str) -> Scene:
    """Read a scene by its name in scenes.json; skips the test where its files are not on this machine."""
    shared("data/scenes.json")
    if name not in ENTRIES:
        pytest.skip(f"../shared/data/scenes.json does not list {name}")
    entry = ENTRIES[name]
    image, depth = shared(f"data/{entry['image']}"), shared(f"data/{entry['depth']}")
    options: dict[str, Any] = {"kind": entry["kind"], "scale": entry["scale"], "invalid": _unknown(entry["invalid"])}
    if entry["kind"] == "disparity":
        options |= {
            key: entry[key] for key in ("focal_px", "baseline_m", "doffs_px") if key in entry
        } or NOMINAL_CALIBRATION
    if "decode" not in entry:
        return read_rgbd(image, depth, **options)
    with tempfile.TemporaryDirectory() as folder:  # SUN RGB-D keeps the bits of a uint16 rotated left by 3
        rotated = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        plain = Path(folder) / "depth.png"
        cv2.imwrite(str(plain), (rotated >> 3) | (rotated << 13))
        return read_rgbd(image, plain, **options)


def halves(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Split scenes into half A, from which statistics and settings are taken, and half B, which only scores.

    Names are sorted and drawn in a random order of seed 0. Half A is the first half of that order, with the middle one.
    """
    ordered = sorted(names)
    order = torch.randperm(len(ordered), generator=torch.Generator().manual_seed(0)).tolist()
    drawn, middle = [ordered[index] for index in order], (len(ordered) + 1) // 2
    return sorted(drawn[:middle]), sorted(drawn[middle:])


def _unknown(text: str) -> list[float]:
    """'0 and 65535' -> [0, 65535]; 'none' -> []."""
    return [] if text == "none" else [float(value) for value in text.split(" and ")]
