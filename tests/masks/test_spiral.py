from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from kornia_tidy.masks import SpiralMask
from kornia_tidy.optics import Spectrum, circular_aperture
from kornia_tidy.psf import Pupil, exact_psf_bank
from tests.base import BaseTester

TWO_MASKS = {"spiral": lambda **o: SpiralMask(2, num_zones=3, **{"size": 23, **o})}
ONE_MASK = {"spiral": lambda g: SpiralMask(1, generator=g)}
OVER_PUPIL = True


def turn(before: np.ndarray, after: np.ndarray) -> float:
    """Return the rotation between two PSFs in degrees, from +x towards +y, by the best match of rings."""
    azimuth = np.arange(1440) * 2 * np.pi / 1440
    centre = len(before) // 2
    radius = np.arange(4, centre)[:, None]
    where = [centre + radius * np.sin(azimuth), centre + radius * np.cos(azimuth)]
    one, two = (np.fft.fft(map_coordinates(psf, where, order=3) * radius**0.5, axis=1) for psf in (before, after))
    match = np.fft.ifft(one.conj() * two, axis=1).real.sum(0)
    best = int(match.argmax())
    left, top, right = match[best - 1], match[best], match[(best + 1) % 1440]
    degrees = (best + (left - right) / (left - 2 * top + right) / 2) / 4
    return (degrees + 180) % 360 - 180


class TestSpiralMask(BaseTester):
    @pytest.mark.parametrize("zones", [5, 7])
    def test_feature_the_psf_turns_by_defocus_over_zones_against_the_azimuth(self, zones):
        """Prasad's rotation psi / L to 1 %, and its direction: from +y to +x as the scene comes nearer."""
        phase = SpiralMask(1, 128, zones, initial="rotating").phase.detach().double()
        pupil = Pupil(circular_aperture(128, 2.3 / 128, edges="area"), 2.3 / 128)
        defocus = [-10.0, 0.0, 5.0, 10.0]
        bank = exact_psf_bank(phase, torch.ones(1), pupil, Spectrum.monochrome(), [1.0], defocus, 0.05 * 530e-9, 121)
        psfs = bank.psfs[:, 0].numpy()
        for psi, psf in zip(defocus, psfs, strict=True):
            assert turn(psfs[1], psf) == pytest.approx(-math.degrees(psi / zones), rel=0.01, abs=0.01)

    def test_feature_rings_have_equal_areas_and_wind_as_often_as_charged(self):
        masks = SpiralMask(1, 400, 4, initial="rotating")
        inside = circular_aperture(400, 2.3 / 400).bool()
        areas = masks.zone[inside].bincount()
        self.assert_close(areas / areas.sum(), torch.full((4,), 0.25), rtol=0.01)
        seam = (masks.phase[0, 200] - masks.phase[0, 199]).detach()  # across -x, where the azimuth jumps by 2 pi
        for charge, place in ((1, 0.3), (2, 0.6), (3, 0.8), (4, 0.95)):
            column = round(199.5 - place * 400 / 2.3)
            assert float(seam[column]) == pytest.approx(2 * math.pi * charge, rel=0.02)

    def test_exception_choices(self):
        with pytest.raises(ValueError, match="initial must be one of 'noise', 'rotating', got 'flat'"):
            SpiralMask(initial="flat")
        with pytest.raises(ValueError, match="num_zones must be positive"):
            SpiralMask(num_zones=0)
