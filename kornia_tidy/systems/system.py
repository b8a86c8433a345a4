"""Data type of a published optical system: its parts, and the source of each value."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from kornia_tidy.masks.base import MASK_SPAN, PhaseMasks
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.sensor.noise import SensorNoise

RGB = Spectrum.rgb()
GUESS = "guess"
"""First word in the source of a value that no accessible paper or code states."""


@dataclass(frozen=True)
class System:
    """A published optical system: the values of its parts and their sources.

    Args:
        name: name for :meth:`kornia_tidy.TiDyOptics.from_preset`.
        title: common name.
        paper: publication.
        known_for: its characteristic property in one phrase.
        mask: description of the mask.
        camera: function that returns lens and pixel pitch.
        masks: function from a generator (or None) to the initial masks.
        sources: each value and where it was published; a guess begins with the word "guess".
        spectrum: wavelengths, one for each channel.
        compositing: how depth layers are combined: "gather", "scatter" or "occlusion".
        sigma: standard deviation of the read noise, in units of full scale.
        modulator: function that returns the modulator.
        smooth_iris: whether the iris is a disc with a smooth edge. False: the published grid of open and shut pixels.

    Example:
        >>> from kornia_tidy.systems.presets import published_system
        >>> system = published_system("ikoma2021")
        >>> round(system.camera().f_number, 1), system.compositing
        (6.3, 'occlusion')
        >>> system.guesses
        ('start',)
    """

    name: str
    title: str
    paper: str
    known_for: str
    mask: str
    camera: Callable[[], ThinLensCamera]
    masks: Callable[[torch.Generator | None], PhaseMasks]
    sources: Mapping[str, str]
    spectrum: Spectrum = RGB
    compositing: str = "gather"
    sigma: float = 0.01
    modulator: Callable[[], nn.Module] = DwellTimes
    smooth_iris: bool = True

    @property
    def guesses(self) -> tuple[str, ...]:
        """Names of the values that are guesses."""
        return tuple(name for name, source in self.sources.items() if source.startswith(GUESS))

    @property
    def year(self) -> int:
        """Year of publication."""
        return int(re.findall(r"\b20\d\d\b", self.paper)[-1])

    def parts(self, generator: torch.Generator | None = None, **overrides: Any) -> dict[str, Any]:
        """Return the arguments of :class:`kornia_tidy.TiDyOptics` for the system.

        Args:
            generator: source of the noise of masks that start from noise.
            overrides: arguments that replace the system's. The iris is sampled on the pixels of given masks.

        Returns:
            Keyword arguments by name.
        """
        masks = overrides["masks"] if overrides.get("masks") is not None else self.masks(generator)
        size = min(masks.phase.shape[-2:])
        parts = {
            "camera": self.camera,
            "modulator": self.modulator,
            "sensor": lambda: SensorNoise(self.sigma),
            "aperture": lambda: circular_aperture(size, MASK_SPAN / size, edges="area") if self.smooth_iris else None,
        }
        made = {name: make() for name, make in parts.items() if name not in overrides}
        rest = {"compositing": self.compositing, "spectrum": self.spectrum}
        return {**rest, **made, **overrides, "masks": masks}
