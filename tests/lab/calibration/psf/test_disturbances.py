from __future__ import annotations

import pytest
import torch

from kornia_tidy import SensorNoise, ThinLensCamera
from kornia_tidy.lab.calibration.psf import measure_psfs, point_images
from tests.base import BaseTester

CAMERA, SENSOR, ONCE = ThinLensCamera(), SensorNoise.physical(10500, 2.4), torch.ones(1)
X = torch.arange(90.0)


def captures(level=1.0, spread=1.5, movement=6.0, halo=0.0):
    """Return point images of a round spot, clipped at a level, with a halo around it."""
    generator = torch.Generator().manual_seed(0)
    images = []
    for place in 45 + movement * (torch.rand(8, 2, generator=generator) - 0.5):
        squares = (X[:, None] - place[0]) ** 2 + (X - place[1]) ** 2
        light = 0.8 * torch.exp(-squares / (2 * spread**2)) + halo / (1 + squares / 100) ** 1.5
        frames = SENSOR(light[None, None], generator=generator).clamp(max=level)
        images += point_images(frames, ONCE, SENSOR, 15)
    return {0.6: images}


class TestMeasurePSFs(BaseTester):
    def test_smoke_without_a_disturbance_nothing_is_said(self):
        assert measure_psfs(captures(), CAMERA, 15).distances.tolist() == [0.6]

    def test_exception_captures_that_are_clipped_below_saturation(self):
        words = r"^8 of 8 captures at 0\.6 m have the same brightest value, 0\.500 of full scale, .* saturates there"
        with pytest.raises(ValueError, match=words):
            measure_psfs(captures(level=0.5), CAMERA, 15)

    def test_feature_a_broad_flat_spot_is_not_taken_for_clipped(self):
        measure_psfs(captures(spread=2.5), CAMERA, 15)

    def test_exception_a_point_whose_image_is_wide(self):
        words = (
            r"^the image of a point of 100 um at 0\.6 m is 1\.1 pixels wide, at most 0\.5 .* pinhole of 44 um or less"
        )
        with pytest.raises(ValueError, match=words):
            measure_psfs(captures(), CAMERA, 15, diameter=100e-6)
        with pytest.raises(ValueError, match="diameter"):
            measure_psfs(captures(), CAMERA, 15, diameter=-1e-6)

    def test_feature_the_diameter_of_the_point_sharpens_the_psf_and_widens_its_uncertainty(self):
        images = captures()
        narrow, wide = (measure_psfs(images, CAMERA, 15, diameter=d) for d in (0.0, 40e-6))
        assert float(wide.bank.psfs[0, 0, 7, 7]) > float(narrow.bank.psfs[0, 0, 7, 7])
        assert float(wide.uncertainty[0, 0, 7, 7]) > float(narrow.uncertainty[0, 0, 7, 7])

    def test_exception_a_point_that_stays_on_the_same_pixels(self):
        with pytest.warns(UserWarning, match=r"^the point at 0\.6 m moves by 0\.\d pixels .* move it by 4 or more"):
            measure_psfs(captures(movement=1.0), CAMERA, 15)

    def test_exception_light_around_the_window(self):
        with pytest.warns(UserWarning, match=r"^\d+% of the light at 0\.6 m lies around the window of 15 pixels"):
            measure_psfs(captures(halo=0.02), CAMERA, 15)
