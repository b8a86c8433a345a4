"""Conditions of a coded data set: camera, layout and seed, which must be the same when a run is resumed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.files import error_prefix, json_lines, read_json, standard, write_bytes
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.training.coded_datasets.layout import Layout
from kornia_tidy.version import __version__

CONDITIONS, FORMAT = "render.json", "kornia_tidy captures 1"


def conditions(
    optics: TiDyOptics, count: int, layout: Layout, seed: int, made_from: Mapping[str, Any]
) -> dict[str, Any]:
    """Return all that determines the captures, as plain values for JSON.

    Args:
        optics: the camera.
        count: number of scenes.
        layout: files of the captures.
        seed: of the noise.
        made_from: description of camera and scenes by the caller.

    Convention:
        - Masks are heights in metres with nine digits, which represent float32 exactly; ``state_sha256`` is the hash of
          all weights and the aperture.
        - Infinity, which JSON lacks, is written as ``"inf"``.
    """
    camera = {
        **{name: _part(getattr(optics, name)) for name in ("camera", "masks", "modulator", "sensor")},
        "spectrum": asdict(optics.spectrum),
        "fidelity": asdict(optics.fidelity),
        **{name: getattr(optics, name) for name in ("window", "compositing", "color_space", "border")},
        "state_sha256": camera_digest(optics, settings=False),  # they are written in words
        "heights_m": [[[float(f"{h:.9g}") for h in row] for row in mask] for mask in optics.masks.heights().tolist()],
    }
    versions = {"kornia_tidy": __version__, "torch": torch.__version__}
    about = {"format": FORMAT, "versions": versions, "captures": count, "noise_seed": seed, "files": asdict(layout)}
    return json.loads(json.dumps(standard({**about, "made_from": dict(made_from), **camera}), default=str))


def claim(folder: Path, own: Mapping[str, Any], name: str = CONDITIONS) -> None:
    """Write the conditions into an empty folder, or check that they agree with those in it.

    Raises:
        ValueError: if the folder holds other files or captures; the message names the differences.
    """
    path = folder / name
    others = any(not other.name.startswith(".") for other in folder.iterdir())
    if not path.exists():  # checked after the other files, as another process writes it before them
        if others:
            raise ValueError(f"{folder} holds files that are no captures: choose another folder")
        write_bytes(path, json_lines(own))
        return
    with error_prefix(f"cannot read {path}", AttributeError):
        there = _flat(read_json(path))
    here = _flat(own)
    if other := [name for name in {**there, **here} if there.get(name) != here.get(name)]:
        told = [_told(name, there.get(name), here.get(name)) for name in other]
        raise ValueError(f"{folder} holds captures made otherwise (there / now): {'; '.join(told)}")


def _part(module: nn.Module | None) -> dict[str, Any] | None:
    """Return the repr of a part of the camera and its exact numbers."""
    if module is None:
        return None
    numbers = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, (int, float, tuple)) and not name.startswith("_") and name != "training"
    }
    return {"is": repr(module), **numbers}


def camera_digest(optics: TiDyOptics, *, settings: bool) -> str:
    """Return a hash of a camera's weights and aperture, and of its settings if asked."""
    digest = hashlib.sha256()
    for name, value in {**optics.state_dict(), "aperture": optics.pupil.amplitude}.items():
        if settings or not name.endswith(EXTRA_STATE):
            digest.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _flat(values: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    return {
        name: entry
        for key, value in values.items()
        for name, entry in (
            _flat(value, f"{place}{key}.") if isinstance(value, Mapping) else {f"{place}{key}": value}
        ).items()
    }


def _told(name: str, there: Any, here: Any) -> str:
    text = f"{name} ({there} / {here})"
    return text if len(text) < 120 else name
