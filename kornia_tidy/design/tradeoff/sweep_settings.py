"""Settings of a sweep: the presets, each setting of the fidelity varied by itself, and plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from kornia_tidy.accuracy.planning.planner import Planner
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.fidelity import LAYERS, PRESETS, Fidelity
from kornia_tidy.psf.psf_bank import STRAY_LIGHT

Value = str | float | int | None
PRESET, PLAN = "preset", "plan"  # in place of the name of a setting
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # of the plans
SWEEP_VALUES: dict[str, tuple[Value, ...]] = {
    PRESET: tuple(PRESETS),
    "layers": LAYERS,
    "layer_spacing": (2.5, 2.0, 1.0, 0.5),
    "pixel_tolerance": (1.0, 1e-1, 1e-2, 1e-3, 1e-6),  # the first one samples only the centre of a pixel
    "window": (9, 17, 33, 65, 129, 257),
    "enclosed_energy": (0.5, 0.6, 0.7, 0.8, 0.9),
    "stray_light": STRAY_LIGHT,
    "double": (False, True),
}


class Setting(NamedTuple):
    """One point of a sweep: the name of the varied setting, its value, and the fidelity with this value."""

    knob: str
    value: Value
    fidelity: Fidelity


def sweep_settings(base: str | Fidelity = "balanced", knobs: Sequence[str] = tuple(SWEEP_VALUES)) -> list[Setting]:
    """Return the points of a sweep: the presets, and each setting varied while the others stay at the base.

    The value of the base is part of every sweep. ``enclosed_energy`` raises ``max_window`` to that of the reference,
    since a smaller window could not hold the light.

    Args:
        base: a preset's name, or the fidelity with the varied settings.
        knobs: names of settings from ``SWEEP_VALUES``; ``"preset"`` for the presets.

    Raises:
        ValueError: if a name is not known.

    Example:
        >>> [(step.value, step.fidelity.layer_spacing) for step in sweep_settings("draft", ["layer_spacing"])][:2]
        [(2.5, 2.5), (2.0, 2.0)]
    """
    base = Fidelity.preset(base) if isinstance(base, str) else base
    settings = []
    for knob in knobs:
        check_choice("knob", knob, tuple(SWEEP_VALUES))
        if knob == PRESET:
            settings += [Setting(knob, name, PRESETS[name]) for name in PRESETS]
            continue
        own = getattr(base, knob)
        values = SWEEP_VALUES[knob] if own in SWEEP_VALUES[knob] else (*SWEEP_VALUES[knob], own)
        settings += [Setting(knob, value, _turned(base, knob, value)) for value in values]
    return settings


def planned(
    optics: TiDyOptics, light: Tensor, depth: Tensor, tolerances: Sequence[float] = TOLERANCES
) -> list[Setting]:
    """Return the plans of a scene at some tolerances as points of a sweep; a plan may be the reference itself.

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
