"""What differs from pixel to pixel of a sensor: drawn, recorded, and in the right place in a large picture."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.reconstruction import ClosedForm
from kornia_tidy.reconstruction.trained import update_psfs
from kornia_tidy.sensor import draw_pattern
from tests.base import BaseTester

SIZE = (150, 60)  # rows of a strip: 64


def patterned(**options) -> SensorNoise:
    response, offset = draw_pattern(*SIZE, response=0.02, dark=2e-3, columns=5e-3)
    return SensorNoise(response=response, offset=offset, clip=False, **options)


def camera(sensor: nn.Module | None, **options) -> TiDyOptics:
    torch.manual_seed(2)
    fidelity = Fidelity(window=7, layer_spacing=5.0)
    return TiDyOptics(PixelwiseMask(1), sensor=sensor, fidelity=fidelity, color_space="linear", **options)


def scene() -> tuple[Tensor, Tensor]:
    return torch.rand(1, 3, *SIZE), torch.full((1, 1, *SIZE), 0.7)


class TestDrawPattern(BaseTester):
    def test_feature_deviations_are_those_asked_for(self):
        """Of n draws, the standard deviation is known to a share of 1 / sqrt(2 n); five of those are allowed."""
        response, offset = draw_pattern(400, 500, response=0.02, dark=2e-3, columns=0.0)
        for plane, expected in ((response, 0.02), (offset, 2e-3)):
            assert float(plane.std()) == pytest.approx(expected, rel=5 / (2 * plane.numel()) ** 0.5)
        _, columns = draw_pattern(4, 100_000, columns=1e-3)
        assert torch.equal(columns, columns[:1].expand_as(columns))
        assert float(columns[0].std()) == pytest.approx(1e-3, rel=5 / 200_000**0.5)

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"response": 0.4}, "response must be a standard deviation from 0 to 0.3, got 0.4"),
            ({"height": -1}, "height must be a whole number of at least 1, got -1"),
            ({"dark": -1e-3}, "dark must be a standard deviation zero or positive and finite, got -0.001"),
        ],
    )
    def test_exception(self, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            draw_pattern(**{"height": 3, "width": 3, **options})


class TestPatternedSensor(BaseTester):
    def test_feature_light_is_multiplied_and_an_offset_added(self):
        sensor, light = patterned(sigma=0.0), torch.rand(2, 3, *SIZE)
        self.assert_close(sensor(light), light * sensor.response + sensor.offset)

    def test_feature_shot_noise_is_that_of_the_light_collected(self):
        """A pixel of no response collects no electron, whatever its offset."""
        sensor = SensorNoise(0.0, full_well=100.0, response=torch.zeros(1, 1), offset=torch.full((1, 4), 0.25))
        assert torch.equal(sensor(torch.ones(1, 1, 8, 4)), torch.full((1, 1, 8, 4), 0.25))

    @pytest.mark.parametrize("border", ["reflect", "valid"])
    @torch.no_grad()
    def test_feature_a_picture_in_strips_has_the_pattern_in_its_place(self, border):
        """To the rounding of transforms of strips, some 1e2 units of the last place."""
        sensor, (image, depth) = patterned(full_well=5e3), scene()
        optics = camera(sensor, border=border)
        whole, strips = (
            optics._replace(memory_budget=budget)(image, depth, generator=torch.Generator().manual_seed(1))
            for budget in (1 << 40, 1)
        )
        # An electron more or less, of 5000, where the uniform draw lies that near to a step of the Poisson.
        off = (whole - strips).abs()
        assert float(off.max()) < 1.5 / 5e3 * 1.1
        assert float((off > 1e-5).float().mean()) < 1e-3

    @torch.no_grad()
    def test_feature_a_part_of_the_sensor_is_told_from_another(self):
        sensor, light = patterned(sigma=0.0), torch.rand(1, 1, 20, 30)
        found = sensor(light, origin=(7, 5))
        self.assert_close(found, light * sensor.response[7:27, 5:35] + sensor.offset[7:27, 5:35])

    def test_feature_state_holds_the_pattern(self):
        optics, other = camera(patterned()), camera(patterned())
        assert not torch.equal(other.sensor.offset, optics.sensor.offset)
        other.load_state_dict(optics.state_dict())
        assert torch.equal(other.sensor.offset, optics.sensor.offset)
        assert "sensor.offset" not in camera(SensorNoise()).state_dict()

    def test_gradcheck(self):
        sensor, light = patterned(sigma=0.0).double(), torch.rand(1, 1, 3, 4, dtype=torch.float64, requires_grad=True)
        torch.autograd.gradcheck(sensor, light)

    @pytest.mark.parametrize(
        ("options", "error", "sentence"),
        [
            ({"response": torch.tensor([[-1.0]])}, ValueError, "response must not be negative, got -1.0"),
            ({"offset": torch.tensor([[float("nan")]])}, ValueError, "offset"),
            ({"offset": 0.1}, TypeError, "offset"),
            ({"offset": torch.full((1, 1), 64.0)}, ValueError, "offset must be in units of full scale, .* got 64"),
            ({"response": torch.full((1, 1), 2000.0)}, ValueError, "response must be 1 on average, got 2000"),
            ({"response": torch.ones(0, 4)}, ValueError, r"response must have at least one pixel, got shape \(0, 4\)"),
        ],
    )
    def test_exception_of_maps(self, options, error, sentence):
        with pytest.raises(error, match=sentence):
            SensorNoise(**options)

    def test_exception_a_larger_image_than_the_sensor(self):
        with pytest.raises(ValueError, match=r"response has \(150, 60\) pixels, and the image .* \(151, 60\)"):
            patterned()(torch.rand(1, 1, 151, 60))


class RowCounter(nn.Module):
    """A sensor of somebody else's, that records on which row of it light falls."""

    def forward(self, irradiance, params=None, generator=None, origin=(0, 0)):
        rows = torch.arange(origin[0], origin[0] + irradiance.shape[-2]).to(irradiance)
        return rows[:, None].expand_as(irradiance) / 1000

    def draw(self, shape, device=None, generator=None, dtype=torch.float32):
        return {}


class TestSensor(BaseTester):
    @torch.no_grad()
    def test_feature_every_sensor_is_told_its_place(self):
        image, depth = scene()
        coded = camera(RowCounter(), memory_budget=1)(image, depth)
        self.assert_close(coded[0, 0, :, 0], torch.arange(150.0) / 1000)

    def test_exception_a_sensor_that_does_not_tell_its_noise(self):
        with pytest.raises(TypeError, match=r"RowCounter has no std\(light\) that tells it"):
            update_psfs(ClosedForm(), camera(RowCounter()))

    def test_exception_a_module_that_takes_no_place(self):
        with pytest.raises(TypeError, match=r"sensor must take origin=\(row, column\).* got Dropout.forward\(input\)"):
            camera(nn.Dropout())
