"""Task of a co-design: the scene, lens, sensor and modulator that are given, and the weight of depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_metres, check_part, check_positive
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.design.settings import DesignSettings
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.modulator.modulator import DwellTimes, timeline_of
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.lens.made_lenses import RGB, named_focal_length
from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import FASTEST, FOCAL_LENGTHS, PITCHES, ThinLensCamera
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.sensor.exposure import exposed_sensor, full_well_of
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.settings import check_settings

SLOWEST_LENS = 2.0  # the best f-number of a plain lens below which nothing is out of focus to speak of
_PLACES = 3  # over the field of a real lens
_PER_FOCAL_LENGTH = 1.22 * 2  # Airy disc: diameter / (wavelength * f-number)


@dataclass(frozen=True, kw_only=True)
class DesignTask(DesignSettings):
    """Given quantities of a co-design of aperture, focus and masks. Lengths in metres, light in electrons.

    Args:
        modulator: shows the masks, with its switching, levels and losses. Default: equal dwell times without delay.
            The flat lens, the baseline of masks, has none.
        statistics: of the scenes: power spectrum, light, and the distribution of inverse depth over the range.
        settings: the others, as in :class:`~kornia_tidy.design.settings.DesignSettings`.

    Raises:
        ValueError: if a value is out of its range, a length is not in metres, or nothing is out of focus.
        TypeError: if a part is of another type.

    Example:
        >>> task = DesignTask(depth_range=(0.3, 10.0), electrons=10_000)
        >>> round(task.balanced_f_number)
        56
        >>> DesignTask(focal_length=50)
        Traceback (most recent call last):
        ValueError: focal_length must be metres between 1e-05 and 10 (50 mm is 50e-3), got 50
    """

    modulator: nn.Module = field(default_factory=DwellTimes)
    statistics: SceneStatistics = PHOTOGRAPHS

    def __post_init__(self) -> None:
        check_settings(self)
        if self.lens is not None:
            own = named_focal_length(self.lens)
            if self.focal_length not in (DesignSettings.focal_length, own):
                raise ValueError(
                    f"focal_length must be that of the lens {self.lens!r}, {own:.4g} m, got {self.focal_length:.4g} m: "
                    f"leave it out"
                )
            object.__setattr__(self, "focal_length", own)
        check_metres("focal_length", self.focal_length, *FOCAL_LENGTHS, "50 mm is 50e-3")
        check_metres("pixel_pitch", self.pixel_pitch, *PITCHES, "8 um is 8e-6")
        check_part("modulator", self.modulator, nn.Module, "a modulator such as DwellTimes()")
        check_part("statistics", self.statistics, SceneStatistics, "SceneStatistics such as PHOTOGRAPHS")
        timeline_of(self.modulator, torch.zeros(self.masks, self.mask_size, self.mask_size))  # refuses other counts
        if self.full_well is not None:
            check_positive("full_well", self.full_well)
        self.sensor(self.reference_f_number)  # refuses light and noise out of range
        near, far = self.depth_range
        if 0 < near < far and self.balanced_f_number < SLOWEST_LENS:
            raise ValueError(
                f"depths from {near:g} to {far:g} m are all in focus with a lens of {self.focal_length:g} m at "
                f"f/{self.balanced_f_number:.2g}: if they are millimetres, multiply them by 0.001"
            )
        self.camera(max(self.reference_f_number, FASTEST), 0.5)  # refuses depths out of order
        if near <= 2 * self.focal_length:
            raise ValueError(
                f"depth_range must begin beyond two focal lengths, {2 * self.focal_length:g} m, got {near:g} m"
            )

    @property
    def balanced_f_number(self) -> float:
        r"""F-number at which the geometric blur at the ends of the depth range is as wide as the Airy disc.

        .. math:: N = \sqrt{\frac{f^2 \Delta}{2.44 \lambda}}

        with half the range of inverse depth :math:`\Delta`, focus in its middle.

        Source: Goodman, Introduction to Fourier Optics, section 6.4, for the blur; Hecht, Optics, for the Airy disc.
        """
        near, far = self.depth_range
        half = (1 / near - 1 / far) / 2
        return self.focal_length * math.sqrt(half / (_PER_FOCAL_LENGTH * REFERENCE_WAVELENGTH))

    def f_numbers(self) -> tuple[float, ...]:
        """Return the coarse grid of f-numbers: from four stops wider to one stop slower than balanced, a stop apart.

        A stop is a factor of sqrt 2, which halves the light. Those too wide for a real lens are left out.
        """
        steps = [self.balanced_f_number * 2 ** (step / 2) for step in range(-4, 2)]
        return tuple(f_number for f_number in steps if f_number >= FASTEST and self._traces(f_number))

    def camera(self, f_number: float, focus: float) -> ThinLensCamera:
        """Return the lens at an f-number.

        Args:
            f_number: focal length over aperture diameter.
            focus: in focus, as a fraction of the range of inverse depth from the far end (0) to the near end (1).
        """
        near, far = self.depth_range
        inverse = 1 / far + focus * (1 / near - 1 / far)
        distance = math.inf if inverse == 0 else 1 / inverse
        return ThinLensCamera(
            self.focal_length, self.focal_length / f_number, distance, self.pixel_pitch, self.depth_range
        )

    def sensor(self, f_number: float) -> SensorNoise:
        """Return the sensor, with the light that the f-number admits. See :func:`exposed_sensor`."""
        light = self.electrons, self.reference_f_number, self.read_noise
        return exposed_sensor(f_number, *light, self.capacity)

    @property
    def capacity(self) -> float:
        """Capacity of a pixel in electrons."""
        return full_well_of(self.pixel_pitch) if self.full_well is None else self.full_well

    @property
    def saturating_f_number(self) -> float:
        """F-number at which white just fills the well; at wider apertures the exposure is shorter."""
        return self.reference_f_number * math.sqrt(self.electrons / self.capacity)

    def noise(self, f_number: float) -> float:
        """Return the standard deviation of the noise at the scenes' mean light, full scale 1."""
        return float(self.sensor(f_number).std(torch.tensor(self.statistics.mean, dtype=torch.float64)))

    def psf_model(
        self, masks: PixelwiseMask | None, f_number: float, focus: float, fidelity: Fidelity, spectrum: Spectrum
    ) -> PSFModel:
        """Return the lens with masks in its pupil, or the flat lens for None."""
        camera, real = self.camera(f_number, focus), self.real_lens(f_number, focus)
        if masks is None:
            return PSFModel(flat_mask(self.mask_size), camera, DwellTimes(), fidelity, spectrum, lens=real)
        return PSFModel(masks, camera, self.modulator, fidelity, spectrum, lens=real)

    def real_lens(self, f_number: float, focus: float) -> Lens | None:
        """Return the real lens at an f-number and a focus, None where the lens is ideal.

        Raises:
            ValueError: if it cannot be traced at this f-number.
        """
        if self.lens is None:
            return None
        return _traced(self.lens, f_number, float(self.camera(f_number, focus).focus_distance), self.depth_range[0])

    def places(self) -> tuple[tuple[float, float], ...]:
        """Return places that stand for parts of equal area of a real lens's field, y and x in pixels from its axis."""
        if self.lens is None:
            return ()
        edge = NAMED_LENSES[self.lens]["field"] / self.pixel_pitch / math.sqrt(2)  # along the diagonal
        heights = [edge * math.sqrt((part + 0.5) / _PLACES) for part in range(_PLACES)]
        return tuple((height, height) for height in heights)

    def _traces(self, f_number: float) -> bool:
        try:
            self.real_lens(f_number, 0.5)
        except ValueError:
            return False
        return True

    def search_window(self, f_number: float, focus: float) -> int:
        """Return the side of the PSFs during the search, in pixels: the widest blur disc, half as much again, odd."""
        camera = self.camera(f_number, focus)
        image_distance = float(camera.image_distance)
        step = self.pixel_pitch * camera.aperture_radius / image_distance
        disc = 2 * max(map(abs, camera.defocus_range)) * REFERENCE_WAVELENGTH / (math.pi * step)
        airy = _PER_FOCAL_LENGTH * REFERENCE_WAVELENGTH * image_distance / camera.aperture_diameter / self.pixel_pitch
        return 2 * round(min(max(1.3 * disc + 2 * airy + 8, 33), 129) / 2) + 1


@lru_cache(maxsize=64)
def _traced(name: str, f_number: float, focus_distance: float, nearest: float) -> Lens:
    entry = NAMED_LENSES[name]
    given = f_number, focus_distance, RGB, entry["field"], nearest
    return Lens.from_prescription(entry["prescription"], *given)


def flat_mask(size: int = 23) -> PixelwiseMask:
    """Return the mask of a plain lens: no phase at all."""
    return PixelwiseMask(1, size, initial="flat")


def mask_of(phase: Tensor) -> PixelwiseMask:
    """Return pixel-wise masks of a phase in radians at 530 nm, (K, N, N).

    Example:
        >>> mask_of(torch.ones(2, 23, 23)).phase.shape
        torch.Size([2, 23, 23])
    """
    masks = PixelwiseMask(len(phase), (phase.shape[-2], phase.shape[-1]), initial="flat")
    masks.phase.data.copy_(phase)
    return masks
