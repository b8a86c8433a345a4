from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.augmentation import RandomSensorNoise, sensor_noise
from tests.base import BaseTester

SIGMAS = 6  # standard errors that a mean or a deviation may be off


class TestSensorNoise(BaseTester):
    def test_feature_mean_and_variance_of_light_are_those_of_photon_transfer(self):
        """Variance (w x + d + sigma^2) / w^2: EMVA 1288, section 2."""
        well, sigma, dark, light = 1000.0, 5.0, 20.0, 0.3
        image = torch.full((1, 1, 400, 500), light, dtype=torch.float64)
        noisy = sensor_noise(image, well, sigma, dark, bits=None, color_space="linear")
        variance = (well * light + dark + sigma**2) / well**2
        count = image.numel()
        assert abs(float(noisy.mean()) - light) < SIGMAS * math.sqrt(variance / count)
        assert abs(float(noisy.var()) / variance - 1) < SIGMAS * math.sqrt(2 / count)

    def test_feature_in_linear_light_it_is_the_module_with_the_same_fields(self):
        image = torch.rand(2, 3, 16, 16)
        module = SensorNoise.physical(full_well=2000, read_noise_electrons=4, dark_electrons=10, bits=10)
        fields = module.draw(image.shape)
        mine = sensor_noise(image, 2000.0, 4.0, 10.0, bits=10, color_space="linear", params=fields)
        # Another order of the same operations may round to the neighbouring level.
        assert (mine - module(image, params=fields)).abs().max() < 1.01 / 1023
        self.assert_close(mine.mean(), module(image, params=fields).mean())

    def test_feature_noise_of_srgb_images_is_in_linear_light(self):
        """Dark pixels: where sRGB is steep, the same electrons make more noise of codes."""
        dark, bright = (sensor_noise(torch.full((1, 1, 100, 100), code), 1e3, 3.0).std() for code in (0.1, 0.9))
        linear = sensor_noise(torch.full((1, 1, 100, 100), 0.1), 1e3, 3.0, color_space="linear").std()
        assert dark > bright
        assert linear < dark

    def test_feature_each_image_has_its_own_sensor(self):
        image = torch.full((2, 1, 200, 200), 0.5)
        noisy = sensor_noise(image, torch.tensor([100.0, 10000.0]), bits=None, color_space="linear")
        ratio = noisy[0].std() / noisy[1].std()
        assert abs(float(ratio) / 10 - 1) < SIGMAS * math.sqrt(1 / image[0].numel())

    def test_feature_levels_of_the_converter(self):
        levels = sensor_noise(torch.rand(1, 1, 50, 50), 1e4, 3.0, bits=3, color_space="linear") * 7
        self.assert_close(levels, levels.round())

    def test_feature_a_generator_repeats_it(self):
        image = torch.rand(1, 3, 8, 8)
        a, b = (sensor_noise(image, 100.0, generator=torch.Generator().manual_seed(3)) for _ in range(2))
        assert torch.equal(a, b)

    def test_exception(self):
        image = torch.rand(2, 3, 4, 4)
        with pytest.raises(ValueError, match="read_noise must be zero or positive electrons, and finite, got -1"):
            sensor_noise(image, 100.0, -1.0)
        for name in ("full_well", "read_noise", "dark"):
            with pytest.raises(ValueError, match=f"{name} must be zero or positive electrons, and finite, got inf"):
                sensor_noise(image, **{"full_well": 100.0, name: float("inf")})
        with pytest.raises(ValueError, match="full_well must be positive and above dark"):
            sensor_noise(image, 100.0, dark=100.0)
        with pytest.raises(ValueError, match="full_well must be one number or one for each of 2 images, got 3"):
            sensor_noise(image, torch.ones(3))
        with pytest.raises(TypeError, match="image must be floating point"):
            sensor_noise(image.byte(), 100.0)
        with pytest.raises(ValueError, match="image must be finite, got nan"):
            sensor_noise(image * torch.nan, 100.0)
        with pytest.raises(ValueError, match=r"image must hold values from 0 to 1, got 2\d\d"):
            sensor_noise(255 * image.clamp(min=0.9), 100.0)


class TestRandomSensorNoise(BaseTester):
    def test_feature_is_the_function_with_the_drawn_sensor(self):
        image = torch.rand(3, 3, 8, 8)
        augmentation = RandomSensorNoise(dark=(1.0, 5.0), p=1.0)
        noisy, drawn = augmentation(image), augmentation._params
        for row in range(3):
            values = (float(drawn[name][row]) for name in ("full_well", "read_noise", "dark"))
            source = torch.Generator().manual_seed(int(drawn["seed"][row]))
            self.assert_close(noisy[row : row + 1], sensor_noise(image[row : row + 1], *values, generator=source))

    def test_feature_defaults_are_drawn_over_the_ranges_of_the_documentation(self):
        drawn = RandomSensorNoise(p=1.0).forward_parameters((3000, 3, 8, 8))
        for name, (low, high) in {"full_well": (1e3, 2e4), "read_noise": (1.0, 10.0)}.items():
            assert low <= drawn[name].min() < 1.02 * low
            assert 0.99 * high < drawn[name].max() <= high
        assert not drawn["dark"].any()

    def test_exception(self):
        with pytest.raises(ValueError, match="dark must stay below full_well, got up to 600 of 500 electrons"):
            RandomSensorNoise(full_well=(500.0, 1e3), dark=(0.0, 600.0))
        with pytest.raises(ValueError, match="bits must be a whole number from 1 to 16, got 20"):
            RandomSensorNoise(bits=20)

    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    def test_dynamo(self):
        image = torch.rand(2, 3, 8, 8)
        augmentation = RandomSensorNoise(p=0.5)
        params = augmentation.forward_parameters(image.shape)
        compiled = torch.compile(augmentation, backend="eager")
        self.assert_close(compiled(image, params=params), augmentation(image, params=params))
