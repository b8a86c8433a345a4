from __future__ import annotations

import pytest
import torch

from kornia_tidy import SensorNoise, TiDyOptics
from kornia_tidy.training.drawn_sensors import SensorEach, with_sensor
from tests.base import BaseTester


class TestSensorEach(BaseTester):
    def test_feature_each_capture_has_the_noise_of_its_sensor(self):
        sensors = [SensorNoise(0.0), SensorNoise(0.02), SensorNoise(0.0, full_well=100.0)]
        light = torch.full((3, 3, 64, 64), 0.5)
        batch = SensorEach(sensors)
        seen = batch(light, generator=torch.Generator().manual_seed(0))
        wanted = torch.stack([sensor.std(torch.tensor(0.5)) for sensor in sensors])
        assert torch.equal(seen[0], light[0])
        # 12288 samples: five standard errors of a standard deviation are 3 %
        self.assert_close(seen.std((1, 2, 3)), wanted, rtol=0.04, atol=1e-7)
        self.assert_close(batch.std(light)[:, 0, 0, 0], wanted)

    def test_feature_a_generator_repeats_the_noise_of_all(self):
        batch, light = SensorEach([SensorNoise(0.1), SensorNoise(0.1)]), torch.rand(2, 3, 8, 8)
        one, other = (batch(light, generator=torch.Generator().manual_seed(3)) for _ in range(2))
        assert torch.equal(one, other)
        assert not torch.equal(one[0] - light[0], one[1] - light[1])

    def test_gradcheck(self):
        batch = SensorEach([SensorNoise(0.01), SensorNoise(0.02)])
        light = 0.3 + 0.4 * torch.rand(2, 1, 4, 4, dtype=torch.float64)
        self.gradcheck(lambda x: batch(x, generator=torch.Generator().manual_seed(0)), (light,))

    def test_exception_another_number_of_captures(self):
        with pytest.raises(ValueError, match="2 sensors take as many captures, got 3"):
            SensorEach([SensorNoise(), SensorNoise()])(torch.rand(3, 3, 8, 8))


class TestWithSensor(BaseTester):
    def test_feature_the_camera_has_its_own_sensor_again_whatever_happens(self):
        optics = TiDyOptics(fidelity="draft")
        own = optics.sensor
        other = SensorEach([SensorNoise(0.1), SensorNoise(0.1)])
        with pytest.raises(ValueError, match="2 sensors take as many captures, got 1"), with_sensor(optics, other):
            optics(torch.rand(1, 3, 40, 40), torch.ones(1, 1, 40, 40))
        assert optics.sensor is own
