from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.lab.calibration.psf import capture_variance, merge_exposures
from tests.base import BaseTester
from tests.lab.calibration.psf.captures import exposed

SENSOR = SensorNoise.physical(10500, 2.4)


class TestCaptureVariance(BaseTester):
    def test_feature_equals_the_scatter_of_the_sensors_own_captures(self):
        sensor = SensorNoise(0.002, full_well=5000, dark=40, bits=10, clip=False)
        image = torch.full((1, 1, 400, 400), 0.3, dtype=torch.float64)
        measured = float(sensor(image, generator=torch.Generator().manual_seed(0)).var())
        assert measured == pytest.approx(float(capture_variance(image, sensor)[0, 0, 0, 0]), rel=0.02)


class TestMergeExposures(BaseTester):
    EXPOSURES = torch.tensor([1.0, 8.0, 64.0])

    def test_feature_bright_and_faint_are_both_found_as_sure_as_it_says(self):
        """The scatter over a ramp of four decades agrees with the returned variance."""
        light = torch.logspace(-4, -0.1, 40).view(1, 1, 40).expand(1, 500, 40)
        frames = exposed(light, self.EXPOSURES, torch.Generator().manual_seed(0), 10500, 2.4, 0.0)
        merged, variance = merge_exposures(frames, self.EXPOSURES, SENSOR)
        pull = (merged - light) / variance.sqrt()
        self.assert_close(pull.square().mean((0, 1)), torch.ones(40), rtol=0.35, atol=0)
        assert abs(float(pull.mean())) < 0.1

    @pytest.mark.parametrize("saturation", [0.9, 0.95])
    def test_feature_what_is_saturated_has_no_weight(self, saturation):
        frames = torch.tensor([0.2, 0.99, 1.0]).view(3, 1, 1, 1)
        merged, _ = merge_exposures(frames, self.EXPOSURES, SENSOR, saturation)
        assert float(merged) == pytest.approx(0.2)

    def test_feature_saturated_in_all_is_infinitely_unsure(self):
        merged, variance = merge_exposures(torch.ones(3, 1, 1, 1), self.EXPOSURES, SENSOR)
        assert (float(merged), float(variance)) == (1.0, math.inf)

    @pytest.mark.parametrize("exposures", [[1.0], [1.0, 2.0, 0.0], [1.0, 2.0, math.inf]])
    def test_exception_exposures(self, exposures):
        with pytest.raises(ValueError, match="exposures must be 3 positive numbers"):
            merge_exposures(torch.zeros(3, 1, 4, 4), torch.tensor(exposures), SENSOR)

    def test_exception_counts_are_no_light(self):
        with pytest.raises(TypeError, match="frames must be floating point"):
            merge_exposures(torch.zeros(3, 1, 4, 4, dtype=torch.int32), self.EXPOSURES, SENSOR)
