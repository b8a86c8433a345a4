from __future__ import annotations

import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.lab.calibration.psf import point_images
from kornia_tidy.lab.calibration.psf.point_images import MARGIN, plane_window
from tests.base import BaseTester
from tests.lab.calibration.psf.captures import exposed, planes

SENSOR, ONCE = SensorNoise.physical(10500, 2.4), torch.ones(1)
RGGB = ((0, 1), (1, 2))


def spot(row, column, height=90, width=110, channels=1, spread=8.0):
    down, right = torch.arange(float(height)) - row, torch.arange(float(width)) - column
    return (0.7 * torch.exp(-(down[:, None] ** 2 + right**2) / spread)).expand(channels, -1, -1)


class TestPointImages(BaseTester):
    def test_feature_place_and_light_are_found_in_noise(self):
        light = spot(40.3, 52.8, channels=3)
        frames = exposed(light, ONCE, torch.Generator().manual_seed(0), 10500, 2.4, 0.01)
        (image,) = point_images(frames, ONCE, SENSOR, 21)
        assert image.fault is None
        assert image.place == pytest.approx((40.3, 52.8), abs=0.03)
        assert image.light.shape == (3, 21 + 2 * MARGIN, 21 + 2 * MARGIN)
        assert float(image.light.sum()) == pytest.approx(float(light.sum()), rel=0.02)

    def test_feature_the_reference_says_where_the_chief_ray_falls(self):
        """Coded light three pixels off the chief ray: its centroid is there, that of the reference is on the ray."""
        frames, reference = spot(43, 50)[None], spot(40, 50)
        (alone,) = point_images(frames, ONCE, SENSOR, 31)
        (known,) = point_images(frames, ONCE, SENSOR, 31, reference=reference)
        assert alone.place == pytest.approx((43, 50), abs=0.01)
        assert known.place == pytest.approx((40, 50), abs=0.01)

    @pytest.mark.parametrize("place", [(40.0, 50.0), (41.0, 51.0), (40.4, 51.3)])
    def test_feature_planes_of_a_mosaic_agree_on_one_place(self, place):
        """Positions are in pixels of a plane; its first pixel is the first of the sensor."""
        mosaic = planes(spot(*place, channels=3, spread=24), RGGB)
        (image,) = point_images(mosaic[None], ONCE, SENSOR, 31, tile=RGGB)
        assert image.place == pytest.approx((place[0] / 2, place[1] / 2), abs=0.01)
        assert image.channels == [0, 1, 1, 2]
        assert image.light.shape[-1] == plane_window(31, RGGB) + 2 * MARGIN

    def test_feature_several_points_in_one_picture(self):
        found = point_images((spot(30, 30) + 0.8 * spot(60, 78))[None], ONCE, SENSOR, 15, points=2)
        assert [image.place for image in found] == [
            pytest.approx((30, 30), abs=0.02),
            pytest.approx((60, 78), abs=0.02),
        ]

    def test_exception_a_point_at_the_border_has_a_fault(self):
        (image,) = point_images(spot(4, 55)[None], ONCE, SENSOR, 21)
        assert "leave the picture" in image.fault

    def test_exception_what_does_not_fit(self):
        frames = spot(40, 50)[None]
        with pytest.raises(ValueError, match="window must be odd, so that it has a centre, got 20"):
            point_images(frames, ONCE, SENSOR, 20)
        with pytest.raises(ValueError, match="window must be positive"):
            point_images(frames, ONCE, SENSOR, 0)
        with pytest.raises(ValueError, match=r"reference must have the frames' shape \(1, 90, 110\)"):
            point_images(frames, ONCE, SENSOR, 21, reference=torch.zeros(1, 8, 8))
        with pytest.raises(ValueError, match="a place for each of 1 planes"):
            point_images(frames, ONCE, SENSOR, 21, tile=RGGB)
        with pytest.raises(ValueError, match="does not fit into a picture of 90x110"):
            point_images(frames, ONCE, SENSOR, 101)
        with pytest.raises(TypeError, match="frames must be floating point"):
            point_images(frames.int(), ONCE, SENSOR, 21)
