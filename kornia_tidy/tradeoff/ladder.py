"""What a sweep measures: the presets, and every knob of the fidelity turned alone, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from kornia_tidy.checks import check_choice
from kornia_tidy.fidelity import LAYERS, PRESETS, Fidelity
from kornia_tidy.optics.psf_bank import STRAY_LIGHT

Value = str | float | int | None
PRESET = "preset"  # stands where a knob's name would
LADDERS: dict[str, tuple[Value, ...]] = {
    PRESET: tuple(PRESETS),
    "layers": LAYERS,
    "layer_spacing": (2.5, 2.0, 1.0, 0.5),
    "pixel_tolerance": (1.0, 1e-1, 2e-2, 1e-3, 1e-6),  # the first samples the middle of a pixel, no more
    "window": (9, 17, 33, 65, 129),
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


def _turned(base: Fidelity, knob: str, value: Value) -> Fidelity:
    if value == getattr(base, knob):
        return base
    more = {"max_window": max(base.max_window, PRESETS["reference"].max_window)} if knob == "enclosed_energy" else {}
    return base.replace(**{knob: value}, **more)
