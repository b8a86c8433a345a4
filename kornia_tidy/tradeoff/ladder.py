"""What a sweep measures: the presets, every knob of the fidelity turned alone, step by step, and plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.fidelity import LAYERS, PRESETS, Fidelity
from kornia_tidy.planning.planner import Planner
from kornia_tidy.psf.psf_bank import STRAY_LIGHT

Value = str | float | int | None
PRESET, PLAN = "preset", "plan"  # stand where a knob's name would
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # of the plans
LADDERS: dict[str, tuple[Value, ...]] = {
    PRESET: tuple(PRESETS),
    "layers": LAYERS,
    "layer_spacing": (2.5, 2.0, 1.0, 0.5),
    "pixel_tolerance": (1.0, 1e-1, 1e-2, 1e-3, 1e-6),  # the first samples the middle of a pixel, no more
    "window": (9, 17, 33, 65, 129, 257),
    "enclosed_energy": (0.5, 0.6, 0.7, 0.8, 0.9),
    "stray_light": STRAY_LIGHT,
    "double": (False, True),
}


class Setting(NamedTuple):
    """One step on the ladder of a knob."""

    knob: str
    value: Value
    fidelity: Fidelity


def ladder(base: str | Fidelity = "balanced", knobs: Sequence[str] = tuple(LADDERS)) -> list[Setting]:
    """Return the settings of a sweep: the presets, and each knob turned alone while the others stay.

    The base's own value is a step of every ladder. ``enclosed_energy`` takes ``max_window`` with it, up to that of the
    reference: what it asks for would not be there otherwise.

    Args:
        base: a preset's name, or the setting from which the knobs are turned.
        knobs: names from ``LADDERS``; ``"preset"`` for the presets.

    Raises:
        ValueError: if a name is not known.

    Example:
        >>> [(step.value, step.fidelity.layer_spacing) for step in ladder("draft", ["layer_spacing"])][:2]
        [(2.5, 2.5), (2.0, 2.0)]
    """
    base = Fidelity.preset(base) if isinstance(base, str) else base
    settings = []
    for knob in knobs:
        check_choice("knob", knob, tuple(LADDERS))
        if knob == PRESET:
            settings += [Setting(knob, name, PRESETS[name]) for name in PRESETS]
            continue
        own = getattr(base, knob)
        values = LADDERS[knob] if own in LADDERS[knob] else (*LADDERS[knob], own)
        settings += [Setting(knob, value, _turned(base, knob, value)) for value in values]
    return settings


def planned(
    optics: TiDyOptics, light: Tensor, depth: Tensor, tolerances: Sequence[float] = TOLERANCES
) -> list[Setting]:
    """Return what is planned for a scene at some tolerances; a plan that is the reference itself is one of them.

    Args:
        optics: the camera.
        light: (B, C, H, W) linear light.
        depth: (B, 1, H, W) or (1, 1, H, W).
        tolerances: see :meth:`kornia_tidy.TiDyOptics.plan`.

    Example:
        >>> import torch
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(1, initial="flat"))
        >>> image, depth = torch.rand(1, 3, 32, 32), torch.full((1, 1, 32, 32), 0.9)
        >>> [(step.knob, step.value) for step in planned(optics, image, depth, [1e-2])]
        [('plan', 0.01)]
    """
    scene = Planner(optics, light.shape[1]).scene(optics.camera.defocus(depth), light)
    return [Setting(PLAN, tolerance, scene.plan(tolerance).fidelity) for tolerance in tolerances]


def _turned(base: Fidelity, knob: str, value: Value) -> Fidelity:
    if value == getattr(base, knob):
        return base
    more = {"max_window": max(base.max_window, PRESETS["reference"].max_window)} if knob == "enclosed_energy" else {}
    return base.replace(**{knob: value}, **more)
