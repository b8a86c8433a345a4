"""The base of sensors, by a sensor that multiplies light by grain."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import SensorNoise, TiDyOptics
from kornia_tidy.sensor import Sensor
from tests.base import BaseTester


class Film(Sensor):
    noise = {"grain": torch.randn}  # noqa: RUF012

    def record(self, light, noise, origin):
        return light * (1 + 0.1 * noise["grain"]) + 1e-3 * origin[0]


class TestSensor(BaseTester):
    def test_feature_what_is_drawn_is_recorded(self):
        film, light = Film(), torch.rand(2, 3, 70, 5)
        drawn = film.draw(light.shape)
        assert torch.equal(film(light, params=drawn, origin=(2, 0)), light * (1 + 0.1 * drawn["grain"]) + 2e-3)

    def test_feature_a_camera_takes_it(self):
        optics = TiDyOptics(sensor=Film(), fidelity="draft", color_space="linear")
        image, depth = torch.rand(1, 3, 40, 48), torch.full((1, 1, 40, 48), 0.8)
        params = optics.draw(image)
        with torch.no_grad():
            clean = TiDyOptics(optics.masks, sensor=None, fidelity="draft", color_space="linear")(image, depth)
            self.assert_close(optics(image, depth, params=params), clean * (1 + 0.1 * params["grain"]), atol=1e-6)

    def test_feature_noise_is_a_hundredth_of_full_scale_by_default(self):
        light, params = torch.full((1, 1, 4, 4), 0.5), {"read": torch.ones(1, 1, 4, 4)}
        self.assert_close(SensorNoise()(light, params=params), light + 0.01)

    def test_exception_params_of_another_sensor(self):
        with pytest.raises(ValueError, match=r"params must hold the field 'grain' as draw\(\) returns it, got \[\]"):
            Film()(torch.ones(1, 1, 4, 4), params={})

    def test_exception_nothing_is_recorded_by_the_base(self):
        with pytest.raises(NotImplementedError):
            Sensor()(torch.ones(1, 1, 4, 4))

    @pytest.mark.parametrize("sensor", [Film(), SensorNoise(0.01)], ids=["own", "noise"])
    @pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
    def test_exception_light_that_is_no_number(self, sensor, bad, device, dtype):
        light = torch.ones(2, 3, 4, 4, device=device, dtype=dtype)
        light[1, 2, 3, 0] = bad
        with pytest.raises(ValueError, match=f"image must be finite, got {bad}"):
            sensor(light)

    def test_feature_eight_bit_values_are_told_once_and_light_is_not(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.optics.units._TOLD", set())
        light = torch.rand(1, 3, 8, 8)
        light[0, 0, 0] = 100.0  # a lamp; warnings are errors
        SensorNoise(0.01)(light)
        SensorNoise(0.01, clip=False)(1000 * light)
        with pytest.warns(UserWarning, match="times full scale on average .*: divide 8-bit values by 255"):
            SensorNoise(0.01)(255 * torch.rand(1, 3, 8, 8))
        with pytest.warns(UserWarning, match="sigma is 5 times full scale: divide 8-bit levels by 255"):
            SensorNoise(5.0)
