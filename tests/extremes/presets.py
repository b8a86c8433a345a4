"""Rows of the presets of fidelity: what each differs from ``reference`` by."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from kornia_tidy import Fidelity
from kornia_tidy.data import DeadLeaves
from tests.extremes.exposure import camera
from tests.extremes.row import Row

GROUP = "Presets"
AGAINST = "reference, root mean square, full scale 1"


@cache
def _scene() -> tuple[Tensor, Tensor]:
    image, depth, _ = DeadLeaves(1, 128, 128, seed=5).read(0)
    return image[None].double(), depth[None].double()


@cache
def _reference(*, correlate: bool) -> Tensor:
    with torch.no_grad():
        return camera(masks=5, fidelity=Fidelity.preset("reference").replace(correlate=correlate, window=127))(
            *_scene()
        )


def _error(name: str, **changes: object) -> float:
    paper = name == "paper"
    fidelity = Fidelity.preset(name).replace(**changes)
    optics = camera(masks=5, fidelity=fidelity, color_space="paper" if paper else "linear")
    with torch.no_grad():
        found = optics(*(part.float() for part in _scene()))
    return float((found.double() - _reference(correlate=paper)).square().mean().sqrt())


def rows() -> list[Row]:
    """Return a row for each preset, on dead leaves with five random masks."""
    half = "bound: the light outside its window, times half of full scale"
    return [
        Row(GROUP, "fidelity", "draft", lambda: _error("draft"), 0.2, AGAINST, half, slow=True),
        Row(GROUP, "fidelity", "balanced", lambda: _error("balanced"), 0.1, AGAINST, half, slow=True),
        Row(GROUP, "fidelity", "balanced, the reference's window and stray light",
            lambda: _error("balanced", window=127, stray_light="veil"), 5e-3, AGAINST,
            "what is left: linear layers 2 rad apart, quadrature, float32", slow=True),
        Row(GROUP, "fidelity", "paper", lambda: _error("paper"), 0.5, AGAINST,
            "not bounded: its pupil aliases beyond 14.7 rad; PSFs flipped in both", slow=True),
    ]  # fmt: skip
