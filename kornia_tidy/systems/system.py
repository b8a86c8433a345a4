"""A published optical system as plain data: what to build, and where each value was read."""

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
"""How the source of a value begins that stands in no text or code that could be read."""


@dataclass(frozen=True)
class System:
    """A published optical system: what to build, and where each value was read.

    Args:
        name: for :meth:`kornia_tidy.TiDyOptics.from_preset`.
        title: what people call it.
        paper: who published it, and where.
        known_for: what to look at.
        mask: the mask in words.
        camera: makes lens and sensor.
        masks: makes the masks from a generator of their noise, or None.
        sources: what each value is and where it was read; a guess begins with that word.
        spectrum: wavelengths, one a channel.
        compositing: how depths come together.
        sigma: standard deviation of the noise, full scale 1.
        modulator: makes what shows the masks.
        smooth_iris: the iris is a disc with a smooth edge. False: the published grid of whole pixels.

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
        """Return the arguments that make a camera of the system.

        Args:
            generator: source of the masks' noise, for those that start from noise.
            overrides: arguments of :class:`kornia_tidy.TiDyOptics` that replace the system's. Given masks get an iris
                that fits them.
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
