"""Restorations of the benchmark: closed forms, each with and without a bilateral filter, and the system's network."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor

from kornia_tidy.reconstruction import ClosedFormHead, Wiener, head
from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.self_ensemble import self_ensemble
from kornia_tidy.reconstruction.tasks import MAPS, depth_logits, split_maps
from kornia_tidy.reconstruction.tikhonov import tikhonov
from tests.benchmarks.results.captures import Capture, encode
from tests.benchmarks.results.systems import System

Settings = dict[str, float]
WEIGHTS = tuple(10 ** (quarter / 4) for quarter in range(-20, 5))
COLORS, SPACES = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6), (1.0, 1.5, 2.0, 3.0, 5.0)
FACTORS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
DIAMETER = 7  # pixels of the bilateral filter
LAYERS = 11  # depths of an inversion that knows the depth
NETWORK = "network"
ENSEMBLE = "network in 8 orientations"


@dataclass(frozen=True)
class Restoration:
    """From a capture to maps by name: ``"image"``, sRGB in [0, 1]; ``"depth"``, normalised inverse depth; and, of a
    network that tells how sure it is of depth, its standard deviation ``"deviation"``."""

    restore: Callable[[Capture, Settings], Mapping[str, Tensor]]
    grid: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Values of each setting, ascending, among which half A chooses."""
    start: Callable[[float], Settings] = lambda _: {}
    """Settings at which the search starts, from the standard deviation of the noise."""


@dataclass(frozen=True)
class ClosedForm:
    """A linear restoration in linear light, with its own settings."""

    light: Callable[[Capture, Settings], Tensor]
    grid: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    start: Callable[[float], Settings] = lambda _: {}


def _tikhonov(capture: Capture, settings: Settings) -> Tensor:
    """Tikhonov inversion with the mean PSF of all depths, towards the capture."""
    bank = capture.system.optics.psf_bank()
    veil = None if bank.veil is None else bank.veil.mean(0)
    return tikhonov(capture.light, bank.psfs.mean(0), settings["weight"], prior=capture.light, veil=veil)


def _weight(sigma: float) -> Settings:
    """The weight that suits five masks: 3e-3 at a noise of 0.002, and more for more noise."""
    return {"weight": 3e-3 * (sigma / 0.002) ** 1.3}


def _tikhonov_by_depth(capture: Capture, settings: Settings) -> Tensor:
    """Tikhonov inversions with the PSFs of 11 depths, blended by the depth that the network estimates."""
    system = capture.system
    lo, hi = system.optics.camera.defocus_range
    bank = system.optics.psf_bank(defocus=torch.linspace(lo, hi, LAYERS, dtype=torch.float64).tolist())
    place = (LAYERS - 1) * _estimate(capture)["depth"]
    light = torch.zeros_like(capture.light)
    for layer in range(LAYERS):
        share = (1 - (place - layer).abs()).clamp(min=0)  # linear between two depths
        if share.any():
            veil = None if bank.veil is None else bank.veil[layer]
            inverted = tikhonov(capture.light, bank.psfs[layer], settings["weight"], prior=capture.light, veil=veil)
            light += share * inverted
    return light


def _wiener(capture: Capture, settings: Settings) -> Tensor:
    """Wiener restoration by the statistics of scenes and the noise, times a factor of the noise power."""
    noise = capture.noise.mean((-2, -1), keepdim=True)
    return Wiener(weight=settings["factor"])(capture.light, capture.system.optics.psf_bank(), noise)


CLOSED_FORMS = {
    "capture": ClosedForm(lambda capture, _: capture.light, start=lambda _: {"color": 0.05, "space": 1.0}),
    "Tikhonov": ClosedForm(_tikhonov, {"weight": WEIGHTS}, _weight),
    "Wiener": ClosedForm(_wiener, {"factor": FACTORS}, lambda _: {"factor": 1.0}),
}
BY_DEPTH = "Tikhonov by estimated depth"
CLOSED_FORMS_WITH_DEPTH = {BY_DEPTH: ClosedForm(_tikhonov_by_depth, {"weight": WEIGHTS}, _weight)}


def bilateral(image: Tensor, color: float, space: float) -> Tensor:
    """Return an sRGB image (1, 3, H, W) smoothed by OpenCV's bilateral filter.

    Source: Tomasi and Manduchi, Bilateral Filtering for Gray and Color Images, ICCV 1998.
    """
    pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
    smooth = cv2.bilateralFilter(pixels, DIAMETER, color, space)
    return torch.from_numpy(smooth).permute(2, 0, 1)[None].clamp(0, 1)


def restorations_for(system: System) -> dict[str, Restoration]:
    """Return the restorations of a system's captures by name: closed forms, and its network where it has one."""
    found = {}
    estimates_both = system.task is not None and {"depth", "image"} <= MAPS[system.task].keys()
    for name, form in (CLOSED_FORMS | (CLOSED_FORMS_WITH_DEPTH if estimates_both else {})).items():
        found[name] = _plain(name, form)
        found[f"{name} + bilateral"] = _with_bilateral(name, form)
    if system.head is not None:
        found[NETWORK] = _network()
        if takes_noise(system):
            found |= {f"{NETWORK}, noise x {factor:g}": _network(factor) for factor in (0.5, 2.0)}
        if any(isinstance(part, ClosedFormHead) and part.network is not None for part in system.head.modules()):
            found[ENSEMBLE] = _network(orientations=8)
    return found


def takes_noise(system: System) -> bool:
    """Return whether a system's network takes the noise level."""
    return system.head is not None and head.takes_noise(system.head)


def _inverted(name: str, form: ClosedForm, capture: Capture, settings: Settings) -> Tensor:
    own = {key: settings[key] for key in form.grid}
    key = (name, *own.values())
    if key not in capture.restored:
        capture.restored[key] = encode(form.light(capture, own))
    return capture.restored[key]


def _plain(name: str, form: ClosedForm) -> Restoration:
    return Restoration(lambda capture, s: {"image": _inverted(name, form, capture, s)}, form.grid, form.start)


def _with_bilateral(name: str, form: ClosedForm) -> Restoration:
    def restore(capture: Capture, settings: Settings) -> dict[str, Tensor]:
        return {"image": bilateral(_inverted(name, form, capture, settings), settings["color"], settings["space"])}

    def start(sigma: float) -> Settings:
        return {"color": 0.2, "space": 2.0, **form.start(sigma)}

    return Restoration(restore, {**form.grid, "color": COLORS, "space": SPACES}, start)


def _network(factor: float = 1.0, orientations: int = 1) -> Restoration:
    """The system's network, told the noise level times a factor where it takes one, averaged over orientations."""

    return Restoration(lambda capture, _: _estimate(capture, factor, orientations))


def _estimate(capture: Capture, factor: float = 1.0, orientations: int = 1) -> dict[str, Tensor]:
    system = capture.system
    assert system.head is not None
    assert system.task is not None
    if (factor, orientations) not in capture.estimates:
        told = {"noise": factor * capture.noise} if takes_noise(system) else {}
        network = system.head if orientations == 1 else self_ensemble(system.head, orientations)
        output = network(capture.image, **told).float()
        maps = split_maps(system.task, output)
        if (logits := depth_logits(system.task, output)) is not None:
            maps["deviation"] = depth_moments(logits)[1]
        capture.estimates[factor, orientations] = {name: value.clamp(0, 1) for name, value in maps.items()}
    return capture.estimates[factor, orientations]


def nearest(values: tuple[float, ...], wanted: float) -> int:
    """Return the index of the value nearest to a wanted one, by their ratio."""
    return min(range(len(values)), key=lambda index: abs(math.log(values[index] / wanted)))
