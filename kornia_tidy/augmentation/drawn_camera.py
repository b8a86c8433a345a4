"""Cameras with drawn settings: another focus, aperture, mask error or switching time, and a sensor for each row."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.modulator.modulator import DwellTimes, LearnableDwellTimes, Modulator, Timeline, timeline_of
from kornia_tidy.modulator.switching import Switching
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.sensor.sensor import SensorNoise


class DrawnOptics(NamedTuple):
    """Drawn settings of the optics for one image. None leaves that of the camera."""

    focus_distance: float | None = None
    """Distance in focus, in metres."""
    aperture_diameter: float | None = None
    """Diameter of the pupil in metres."""
    mask_jitter: float | None = None
    """Standard deviation of the phase error of each mask pixel, in radians at 530 nm."""
    switching_time: float | None = None
    """Duration of a transition between masks, in seconds."""
    seed: int = 0
    """Of the phase errors and of random transitions."""


def drawn_camera(optics: TiDyOptics, drawn: DrawnOptics) -> TiDyOptics:
    """Return a camera with drawn settings. Masks and other parts are shared, so gradients reach them.

    Args:
        optics: the camera.
        drawn: settings that replace its own.

    Raises:
        ValueError: if a setting is out of its range.
        TypeError: if the camera has no lens whose focus or aperture could be drawn, or a modulator that cannot switch.

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(2))
        >>> drawn_camera(optics, DrawnOptics(focus_distance=0.8)).camera.focus_distance, optics.camera.focus_distance
        (0.8, 0.595)
    """
    view = optics.with_fidelity(optics.fidelity)
    view.psf_model = optics.psf_model
    if drawn.focus_distance is not None or drawn.aperture_diameter is not None:
        view.camera = _drawn_lens(optics, drawn)
    modulator = optics.modulator
    if drawn.switching_time is not None:
        modulator = _switching(modulator, drawn.switching_time, drawn.seed)
    if drawn.mask_jitter:
        modulator = PhaseJitter(modulator, drawn.mask_jitter, drawn.seed)
    if modulator is not optics.modulator:
        fitted = view.psf_model.fitted  # the window is that of the masks without error
        view.modulator = modulator
        view.psf_model = view.psf_model.with_window(fitted)
    return view


def _drawn_lens(optics: TiDyOptics, drawn: DrawnOptics) -> ThinLensCamera:
    lens = optics.camera
    if not isinstance(lens, ThinLensCamera):
        raise TypeError(
            f"focus_distance and aperture_diameter need a ThinLensCamera, whose depth is in metres, got a "
            f"{type(lens).__name__}"
        )
    focus = lens.focus_distance if drawn.focus_distance is None else drawn.focus_distance
    diameter = lens.aperture_diameter if drawn.aperture_diameter is None else drawn.aperture_diameter
    fixed = focus.detach().item() if isinstance(focus, Tensor) else focus
    return lens.changed(aperture_diameter=diameter, focus_distance=fixed)


def _switching(modulator: nn.Module, switching_time: float, seed: int) -> nn.Module:
    """Return a modulator like this one, with another switching time."""
    if isinstance(modulator, (DwellTimes, LearnableDwellTimes)):
        return Switching(switching_time, dwell=modulator, seed=seed)
    if isinstance(modulator, Switching):
        settings = modulator.exposure, modulator.between, modulator.dwell, modulator.cyclic, modulator.samples
        return Switching(switching_time, *settings, seed=seed)
    raise TypeError(
        f"switching_time needs a modulator of DwellTimes or Switching, got a {type(modulator).__name__}: leave it out"
    )


class PhaseJitter(Modulator):
    """Random phase error of each mask pixel, constant during an exposure.

    Args:
        modulator: shows the masks with their error.
        sigma: standard deviation of the error in radians at 530 nm.
        seed: of the errors. The global generator is neither read nor changed.

    Example:
        >>> states, _ = PhaseJitter(DwellTimes(), 0.1, seed=3)(torch.zeros(2, 23, 23))
        >>> bool((states.std() - 0.1).abs() < 0.01)
        True
    """

    def __init__(self, modulator: nn.Module, sigma: float, seed: int) -> None:
        super().__init__()
        self.modulator, self.sigma, self.seed = modulator, sigma, seed

    @property
    def fill_factor(self) -> float:
        """Fraction of each pixel's area that modulates."""
        return getattr(self.modulator, "fill_factor", 1.0)

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the states and weights of the masks with their errors."""
        error = torch.randn(phase.shape, generator=torch.Generator().manual_seed(self.seed), dtype=torch.float64)
        return timeline_of(self.modulator, phase + self.sigma * error.to(phase))


class RowSensors(nn.Module):
    """A sensor whose exposure, noise level and noise differ from image to image of a batch.

    Args:
        sensor: that of the camera; None records light without noise.
        params: ``"seed"`` of each image's noise, and, where they were drawn, ``"exposure"``, a factor of light, and
            ``"noise_level"``, the standard deviation of the read noise in units of full scale. Each (B,).

    Shape:
        - irradiance: (B, C, H, W), to the same shape.

    Convention:
        - Each image has its own generator on the CPU: its noise depends neither on the batch nor on the device.
        - One object is for one capture: an image that comes in bands continues its generator.
    """

    def __init__(self, sensor: nn.Module | None, params: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.exposures = params["exposure"].tolist() if "exposure" in params else None
        seeds = params["seed"].tolist()
        levels = params["noise_level"].tolist() if "noise_level" in params else [None] * len(seeds)
        self.sensors = [sensor_with(sensor, level) for level in levels]
        self.generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def forward(
        self,
        irradiance: Tensor,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        origin: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Return the record of each sensor. ``params`` and ``generator`` are not for rows with their own noise."""
        rows = []
        for row, light in enumerate(irradiance.split(1)):
            seen = light if self.exposures is None else light * self.exposures[row]
            sensor = self.sensors[row]
            rows.append(seen if sensor is None else sensor(seen, generator=self.generators[row], origin=origin))
        return torch.cat(rows)


def sensor_with(sensor: nn.Module | None, noise_level: float | None) -> nn.Module | None:
    """Return a sensor like this one with another standard deviation of the read noise.

    Raises:
        TypeError: if the sensor is not a SensorNoise.

    Example:
        >>> sensor_with(SensorNoise(0.01, bits=8), 0.02)
        SensorNoise(read noise 0.02 of full scale, no shot noise, 8 bits, clipped to [0, 1])
    """
    if noise_level is None:
        return sensor
    if sensor is None:
        return SensorNoise(noise_level)
    if not isinstance(sensor, SensorNoise):
        raise TypeError(f"noise_level needs a SensorNoise, got a {type(sensor).__name__}: leave it out")
    other = copy.copy(sensor)
    other.sigma = noise_level
    return other
