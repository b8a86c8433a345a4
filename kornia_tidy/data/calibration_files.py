"""Calibration of a stereo scene, read from its file: Middlebury's calib.txt, or JSON."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Any

from kornia_tidy.files import error_prefix, read_json, read_text

OPTIONS = ("focal_px", "baseline_m", "doffs_px", "scale")
_ENTRY = re.compile(r"^\s*(\w+)\s*=\s*(\[[^\]]*\]|[-+.\deE]+)\s*$", re.MULTILINE)
_NAMED = re.compile(r"^\s*(cam0|baseline|doffs)\s*[=:].*$", re.MULTILINE | re.IGNORECASE)


def read_calibration(path: str | os.PathLike[str]) -> dict[str, float]:
    r"""Read the options of :func:`~kornia_tidy.data.depth_files.read_depth` that a scene's calibration determines.

    Args:
        path: a JSON file with some of ``focal_px``, ``baseline_m``, ``doffs_px`` and ``scale``, or a text as
            Middlebury's ``calib.txt``, with ``cam0``, ``baseline`` in millimetres and ``doffs``.

    Returns:
        Options by name: pixels and metres.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if an entry is missing or has another type.

    Source: Scharstein et al., High-Resolution Stereo Datasets with Subpixel-Accurate Ground Truth (GCPR 2014).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "calib.txt")
        ...     _ = path.write_text("cam0=[3997.5 0 1176.7; 0 3997.5 1011.7; 0 0 1]\ndoffs=131.25\nbaseline=193.5\n")
        ...     read_calibration(path)
        {'focal_px': 3997.5, 'baseline_m': 0.1935, 'doffs_px': 131.25}
    """
    if Path(path).suffix.lower() == ".json":
        values: Any = read_json(path)
        if not isinstance(values, dict) or not values or not set(values) <= set(OPTIONS):
            known = f"a calibration holds some of {', '.join(OPTIONS)}, and nothing else"
            raise ValueError(f"cannot read {path}: {known}, got {values!s:.80}")
        if wrong := [name for name, value in values.items() if type(value) not in {int, float}]:
            raise ValueError(f"cannot read {path}: {wrong[0]} must be a number, got {values[wrong[0]]!r:.40}")
    else:
        text = "\n".join(read_text(path, "replace").splitlines())
        found = _ENTRY.findall(text)
        entries = dict(found)
        if unread := [line[0] for line in _NAMED.finditer(text) if line[1].lower() not in entries]:
            raise ValueError(f"cannot read {path}: {unread[0].strip()!r:.80} is no number, with a point, or matrix")
        if len(entries) < len(found):
            raise ValueError(f"cannot read {path}: it gives an entry twice: {', '.join(name for name, _ in found)}")
        camera = re.findall(r"[-+.\deE]+", entries.get("cam0", ""))
        if len(camera) != 9 or not {"baseline", "doffs"} <= set(entries):
            raise ValueError(
                f"cannot read {path}: Middlebury's calibration has cam0=[f 0 cx; 0 f cy; 0 0 1], baseline= and doffs=, "
                f"found {', '.join(entries)[:80] or 'none of them'}"
            )
        values = {"focal_px": camera[0], "baseline_m": entries["baseline"], "doffs_px": entries["doffs"]}
    with error_prefix(f"cannot read {path}", OverflowError, TypeError):
        numbers = {name: float(value) for name, value in values.items()}
    if Path(path).suffix.lower() != ".json":
        numbers["baseline_m"] /= 1000  # millimetres
    for name, number in numbers.items():
        if not math.isfinite(number) or (number <= 0 and name != "doffs_px"):
            raise ValueError(f"cannot read {path}: {name} must be positive and finite, got {number}")
    return numbers
