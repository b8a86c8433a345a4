"""Parts of cameras made from saved states: from the settings, then the weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from inspect import Parameter, signature
from types import SimpleNamespace
from typing import Any, cast

import torch
from torch import Tensor, nn

from kornia_tidy import masks, modulator, optics, sensor
from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.masks.limits import CONSTRAINTS
from kornia_tidy.modulator.modulator import LearnableDwellTimes
from kornia_tidy.optics.materials import DISPERSIONS, Material
from kornia_tidy.optics.thin_lens import DefocusRange
from kornia_tidy.psf.camera_settings import EXTRA_STATE, read_settings, settings_of, take_over

KINDS: dict[str, type] = {"Fidelity": Fidelity} | {
    name: kind
    for package in (masks, modulator, optics, sensor)
    for name, kind in vars(package).items()
    if isinstance(kind, type) and (issubclass(kind, nn.Module) or is_dataclass(kind))
}
"""Classes of the parts that can be made from a state, by their names: those that the packages offer."""

MOST_VALUES = 1 << 28  # of a family's tables; a small file could name a mask that takes gigabytes


def masks_of_state(state: Mapping[str, Tensor]) -> PhaseMasks:
    """Return the masks of a camera that was saved, with their family, constraint, range and material.

    Args:
        state: as in :func:`~kornia_tidy.camera.saved_camera.camera_of_state`. Its other parts may be of any class.

    Raises:
        ValueError: if the state has no settings, the family is unknown, or weights do not fit.

    Example:
        >>> from kornia_tidy import TiDyOptics
        >>> from kornia_tidy.masks import RadialMask
        >>> saved = TiDyOptics(RadialMask(2, constraint="sigmoid", max_height=2e-6))
        >>> torch.equal(masks_of_state(saved.state_dict()).heights(), saved.masks.heights())
        True
    """
    return cast("PhaseMasks", part_of("masks", settings_in(state), state))


def modulator_of_state(state: Mapping[str, Tensor]) -> nn.Module | None:
    """Return the modulator of a camera that was saved; None if its class is unknown.

    Args:
        state: as in :func:`~kornia_tidy.camera.saved_camera.camera_of_state`.

    Example:
        >>> from kornia_tidy import DwellTimes, PixelwiseMask, TiDyOptics
        >>> modulator_of_state(TiDyOptics(PixelwiseMask(2), modulator=DwellTimes((3, 1))).state_dict())
        DwellTimes(dwell shares (0.75, 0.25))
    """
    settings = settings_in(state)
    known = _classes(settings.get("modulator")) <= {*KINDS, "Sequential"}
    return cast("nn.Module", part_of("modulator", settings, state)) if known else None


def checked_settings(state: Mapping[str, Tensor], here: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a saved camera, to be taken over by the present one: their parts can be made.

    Of masks only the limits are checked, since a state may lack their weights; of classes that this package does not
    offer, nothing.

    Args:
        state: as in :func:`~kornia_tidy.camera.saved_camera.camera_of_state`.
        here: settings of the present camera.

    Raises:
        ValueError: if there are no settings, or a part that differs cannot be made.
    """
    settings = settings_in(state)
    if "masks" in settings and settings["masks"] != here["masks"]:
        _check_limits(settings["masks"])
    for name in ("camera", "modulator", "sensor", "spectrum", "fidelity"):
        if name in settings and settings[name] != here[name] and _classes(settings[name]) <= {*KINDS, "Sequential"}:
            part_of(name, settings, state)
    return settings


def settings_in(state: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the settings of a saved camera.

    Args:
        state: as in :func:`~kornia_tidy.camera.saved_camera.camera_of_state`.

    Raises:
        ValueError: if the state has none, or they are damaged.
    """
    if EXTRA_STATE not in state:
        raise ValueError(f"the state has no entry {EXTRA_STATE!r}, only {', '.join(state)[:200] or 'nothing'}")
    return read_settings(state[EXTRA_STATE])


def part_of(name: str, settings: Mapping[str, Any], state: Mapping[str, Tensor]) -> Any:
    """Return a part of a camera with its settings and weights.

    Args:
        name: of the part.
        settings: of the saved camera, see :func:`settings_in`.
        state: its weights.

    Raises:
        ValueError: if it cannot be made.
    """
    weights = below(state, f"{name}.")
    try:
        for key, value in weights.items():
            if not value.is_floating_point() or value.element_size() < 2:
                raise TypeError(f"{key} must be floating point of 16 bits or more, got {value.dtype}")
        if name == "masks":
            _check_limits(settings[name])
        with torch.random.fork_rng(devices=[]):
            part = _made(settings[name], weights, tuple(settings.get("mask_pixels", ())))
        if isinstance(part, nn.Module):
            holder, here = SimpleNamespace(part=part), {name: settings_of(part)}
            take_over(holder, {name: settings[name]}, here, {name: "part"})  # what no argument says, such as max_phase
            part.load_state_dict(weights)
        return part
    except (ArithmeticError, AttributeError, IndexError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = str(error).replace("\n", " ")
        raise ValueError(f"the {name} of the camera's state cannot be made: {reason:.300}") from error


def _made(described: Any, weights: Mapping[str, Tensor], pixels: tuple[int, ...]) -> Any:
    """Return what settings describe. Arguments of a class are its settings and weights of the same names."""
    if isinstance(described, list):
        return tuple(_made(entry, {}, ()) for entry in described)
    if not isinstance(described, Mapping):
        return described
    kind = KINDS.get(described["is"])
    if kind is None:
        raise ValueError(
            f"a {described['is']!s:.80} is no class of this package: make the camera in Python, then load the state"
        )
    given: dict[str, Any] = {**weights, **described}
    if kind is DefocusRange:
        given["camera"] = given.pop("lens")  # the name in states
    if kind is Material:
        given["dispersion"] = DISPERSIONS[described["dispersion"]]
    if issubclass(kind, PhaseMasks | LearnableDwellTimes):
        if not weights and kind is not masks.NoMask:
            raise ValueError("it has no weights")
        given |= kind.arguments_of(weights)
    if issubclass(kind, PhaseMasks):
        _check_tables(weights, pixels)
        given |= {"size": pixels}
        given.pop("constraint")  # set later, with its range in radians
    parts: list[Any] = []
    arguments: dict[str, Any] = {}
    for name, parameter in signature(kind).parameters.items():
        if parameter.kind is Parameter.VAR_POSITIONAL:
            parts = [
                _made(entry, below(weights, f"{name}.{place}."), ())
                for place, entry in described[name].items()
                if place != "is"
            ]
        elif name in given:
            value = given[name]
            inner = isinstance(value, Mapping | list)
            arguments[name] = _made(value, below(weights, f"{name}."), ()) if inner else value
    return kind(*parts, **arguments)


def _check_limits(described: Any) -> None:
    """Raise an error unless masks have a known constraint and a range of phase, which are set after they are made."""
    if isinstance(described, Mapping):
        check_choice("constraint", described.get("constraint"), CONSTRAINTS)
        check_positive("max_phase", described.get("max_phase"), "radians")


def _check_tables(weights: Mapping[str, Tensor], pixels: tuple[int, ...]) -> None:
    rows, columns = pixels
    values = rows * columns * max((weight[0].numel() for weight in weights.values()), default=1)
    if "phase" in weights:
        values = weights["phase"].numel()
    if min(rows, columns) < 1 or values > MOST_VALUES:
        raise ValueError(f"masks of {rows}x{columns} pixels must take at most {MOST_VALUES} values, got {values}")


def below(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the weights whose names begin with a prefix, under their names without it."""
    return {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}


def _classes(described: Any) -> set[str]:
    """Return the names of all classes that settings name."""
    if isinstance(described, list):
        return set().union(*map(_classes, described))
    if not isinstance(described, Mapping):
        return set()
    own = {str(described["is"])} if "is" in described else set()
    return own.union(*map(_classes, described.values())) - {"tensor"}
