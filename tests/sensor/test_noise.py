"""Sensor noise against the photon transfer curve, and against clipping and quantisation written out."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kornia_tidy.sensor import SensorNoise, quantize
from tests.base import BaseTester

needs_more_than_half = pytest.mark.parametrize("wide", [torch.float32, torch.float64], ids=str)
needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="inductor needs a C++ compiler, none is on the path"
)


def gradient_of(function, at: torch.Tensor) -> torch.Tensor:
    at = at.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(function(at).sum(), at)
    return gradient


class TestQuantize(BaseTester):
    @pytest.mark.parametrize("bits", [0, 17, -1, 8.0, "8"])
    def test_exception_names_the_bits(self, device, bits):
        with pytest.raises(ValueError, match=f"bits must be a whole number from 1 to 16, got {bits!r}"):
            quantize(torch.zeros(1, device=device), bits)

    @pytest.mark.parametrize("bits", [1, 2, 8, 12, 16])
    @needs_more_than_half
    def test_feature_the_unit_interval_holds_all_levels(self, device, wide, bits):
        steps = 2**bits - 1
        ramp = torch.linspace(0, 1, 8 * steps + 1, device=device, dtype=wide)
        codes = (quantize(ramp, bits).double() * steps).cpu()
        self.assert_close(codes.unique(), codes.round().unique(), atol=4e-3, rtol=0.0)
        assert codes.round().unique().tolist() == list(range(steps + 1))

    def test_feature_values_go_to_the_nearest_level(self, device, dtype):
        ramp = torch.rand(1000, device=device, dtype=dtype)
        assert (quantize(ramp, 6) - ramp).abs().max() <= 0.5 / 63 + 1e-6

    def test_feature_values_beyond_one_go_on_in_the_same_steps(self, device, dtype):
        out = quantize(torch.tensor([-0.4, 1.3, 2.0], device=device, dtype=dtype), 2)
        self.assert_close(out, torch.tensor([-1 / 3, 4 / 3, 2.0], device=device, dtype=dtype))

    def test_feature_gradient_is_one_everywhere(self, device, dtype):
        values = torch.tensor([-0.5, 0.0, 0.3, 1.0, 1.5], device=device, dtype=dtype)
        assert gradient_of(lambda x: quantize(x, 3), values).tolist() == [1.0] * 5


class TestSensorNoise(BaseTester):
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"sigma": -0.1}, "sigma must be zero or positive and finite, in units of full scale, got -0.1"),
            ({"sigma": float("nan")}, "sigma must be zero or positive and finite, in units of full scale, got nan"),
            ({"full_well": 0.0}, "full_well must be positive and finite electrons, got 0.0"),
            ({"full_well": -5.0}, "full_well must be positive and finite electrons, got -5.0"),
            ({"full_well": 1e31}, r"full_well must be electrons between 1e-30 and 1e\+30, got 1e\+31"),
            ({"bits": 0}, "bits must be a whole number from 1 to 16, got 0"),
            ({"bits": 17}, "bits must be a whole number from 1 to 16, got 17"),
            ({"dark": 3.0}, "dark needs full_well, .* got dark = 3.0 without it"),
            ({"dark": -3.0, "full_well": 9.0}, "dark must be zero or positive and finite, electrons, got -3.0"),
            ({"dark": 9.0, "full_well": 9.0}, "dark must be below full_well, 9.0 electrons, got 9.0"),
        ],
    )
    def test_exception_of_the_constructor_names_the_value(self, options, message):
        with pytest.raises(ValueError, match=message):
            SensorNoise(**options)

    def test_exception_of_physical_is_in_electrons(self):
        with pytest.raises(ValueError, match=r"read_noise_electrons .* electrons, got -2"):
            SensorNoise.physical(1000, -2)
        with pytest.raises(ValueError, match="full_well must be positive and finite electrons, got 0"):
            SensorNoise.physical(0, 2)

    def test_exception_of_the_image_names_its_type_or_shape(self, device):
        with pytest.raises(TypeError, match=r"got torch\.uint8"):
            SensorNoise()(torch.zeros(1, 3, 4, 4, device=device, dtype=torch.uint8))
        with pytest.raises(TypeError, match="got ndarray"):
            SensorNoise()(np.zeros((1, 3, 4, 4)))
        with pytest.raises(ValueError, match=r"shape \(B, C, H, W\), got \(3, 4, 4\)"):
            SensorNoise()(torch.zeros(3, 4, 4, device=device))

    def test_exception_of_params_names_the_field(self, device):
        sensor, image = SensorNoise(full_well=100), torch.zeros(1, 3, 4, 4, device=device)
        params = sensor.draw(image.shape, device=device)
        with pytest.raises(ValueError, match=r"params must hold the field 'shot' .* got \['read'\]"):
            sensor(image, {"read": params["read"]})
        with pytest.raises(ValueError, match=r"params\['read'\] must have the image's shape .*, got \(3, 4, 4\)"):
            sensor(image, {**params, "read": params["read"][0]})
        with pytest.raises(ValueError, match="got both"):
            sensor(image, params, torch.Generator())

    def test_exception_of_draw_names_the_dtype(self):
        with pytest.raises(ValueError, match=r"dtype must be one of torch.float32, torch.float64, got torch.float16"):
            SensorNoise().draw((1, 3, 4, 4), dtype=torch.float16)

    def test_feature_draw_gives_only_the_fields_needed(self, device):
        shape = (1, 3, 4, 4)
        assert SensorNoise(0.0).draw(shape, device=device) == {}
        assert list(SensorNoise(0.1).draw(shape, device=device)) == ["read"]
        assert list(SensorNoise(0.0, full_well=10).draw(shape, device=device)) == ["shot"]
        fields = SensorNoise(0.1, full_well=10).draw(shape, device=device, dtype=torch.float64)
        assert list(fields) == ["read", "shot"]
        for field in fields.values():
            assert (field.shape, field.dtype, field.device.type) == (shape, torch.float64, device.type)

    def test_feature_photon_transfer(self, device):
        """Variance over mean is a line of gradient 1 / full_well and intercept sigma² + LSB² / 12."""
        sigma, full_well, bits, count = 2e-3, 1e4, 8, 1 << 18
        sensor = SensorNoise(sigma, full_well=full_well, bits=bits)
        levels = torch.linspace(0.05, 0.6, 8, device=device, dtype=torch.float64).view(1, 8, 1, 1)
        out = sensor(levels.expand(1, 8, 512, count // 512))
        variance = out.var(dim=(0, 2, 3)).cpu().numpy()
        mean = out.mean(dim=(0, 2, 3)).cpu().numpy()
        self.assert_close(torch.from_numpy(mean), levels.flatten().cpu(), atol=1e-4, rtol=0.0)
        (slope, intercept), covariance = np.polyfit(
            mean, variance, 1, w=1 / (variance * np.sqrt(2 / count)), cov="unscaled"
        )
        errors = np.sqrt(np.diag(covariance))
        lsb = 1 / (2**bits - 1)
        assert abs(slope - 1 / full_well) < 5 * errors[0]
        assert abs(intercept - sigma**2 - lsb**2 / 12) < 5 * errors[1]
        assert lsb**2 / 12 > 20 * errors[1]  # so that the test notices if the term is missing

    @pytest.mark.parametrize(("sigma", "dark", "full_well"), [(0.05, 0.0, None), (0.0, 400.0, 1e4), (0.01, 400.0, 1e4)])
    def test_feature_a_dark_frame_has_no_mean_and_the_variance_of_its_parts(self, device, sigma, dark, full_well):
        sensor = SensorNoise(sigma, full_well=full_well, dark=dark, clip=False)
        out = sensor(torch.zeros(1, 1, 512, 512, device=device, dtype=torch.float64))
        variance = sigma**2 + (dark / full_well**2 if full_well else 0.0)
        assert abs(out.mean().item()) < 5 * (variance / out.numel()) ** 0.5
        assert abs(out.var().item() / variance - 1) < 5 * (2.1 / out.numel()) ** 0.5

    def test_feature_negative_light_takes_no_dark_signal_away(self, device, dtype):
        sensor, dark_frame = (
            SensorNoise(0.0, full_well=1e4, dark=400),
            torch.zeros(1, 1, 8, 8, device=device, dtype=dtype),
        )
        params = sensor.draw(dark_frame.shape, device=device)
        assert torch.equal(sensor(dark_frame - 0.02, params), sensor(dark_frame, params))

    def test_feature_highlights_stop_at_the_full_well(self, device, dtype):
        """Dark signal fills part of the well, so a saturated pixel reads less than 1."""
        bright = torch.full((1, 1, 8, 8), 3.0, device=device, dtype=dtype)
        out = SensorNoise(0.0, full_well=1000, dark=100)(bright)
        self.assert_close(out, torch.full_like(out, 0.9))

    def test_feature_the_full_well_is_cut_before_read_noise(self, device, dtype):
        """A saturated pixel keeps its read noise below the full scale."""
        bright = torch.full((1, 1, 64, 64), 3.0, device=device, dtype=dtype)
        saturated = SensorNoise(0.01, full_well=1e4)(bright)
        assert 0.3 < (saturated < 1).double().mean().item() < 0.7

    @needs_more_than_half
    def test_feature_converter_uses_its_levels_and_no_others(self, device, wide):
        out = SensorNoise(0.2, bits=3)(torch.rand(1, 3, 64, 64, device=device, dtype=wide))
        codes = (7 * out.double()).cpu()
        self.assert_close(codes, codes.round(), atol=1e-5, rtol=0.0)
        assert codes.round().unique().tolist() == [0, 1, 2, 3, 4, 5, 6, 7]

    def test_gradcheck(self, device):
        """The differentiable steps: shot noise above 25 electrons, dark signal and read noise from given fields."""
        sensor = SensorNoise(0.01, full_well=1000, dark=20, clip=False)
        params = sensor.draw((1, 2, 3, 4), device=device, dtype=torch.float64)
        self.gradcheck(lambda x: sensor(x, params), (0.1 + 0.9 * torch.rand(1, 2, 3, 4, device=device),))

    def test_feature_params_replay_bit_for_bit(self, device, dtype):
        sensor, image = SensorNoise.physical(50, 2, 3), torch.rand(2, 3, 8, 8, device=device, dtype=dtype)
        params = sensor.draw(image.shape, device=device)
        first = sensor(image, params)
        assert torch.equal(first, sensor(image, params))
        assert not torch.equal(first, sensor(image, sensor.draw(image.shape, device=device)))

    def test_feature_a_generator_reproduces_and_leaves_the_global_one(self, device, dtype):
        """A CPU generator gives the same noise to an image on any device."""
        sensor, image = SensorNoise.physical(50, 2), torch.rand(2, 3, 8, 8, device=device, dtype=dtype)
        state = torch.get_rng_state()
        first, second, other = (sensor(image, generator=torch.Generator().manual_seed(s)) for s in (1, 1, 2))
        assert torch.equal(first, second)
        assert not torch.equal(first, other)
        assert torch.equal(state, torch.get_rng_state())

    def test_feature_eval_keeps_the_noise(self, device, dtype):
        sensor, image = SensorNoise(0.01), torch.full((1, 3, 8, 8), 0.5, device=device, dtype=dtype)
        params = sensor.draw(image.shape, device=device)
        noisy = sensor(image, params)
        assert noisy.std() > 5e-3
        assert torch.equal(sensor.eval()(image, params), noisy)

    @pytest.mark.parametrize("value", [0.0, -2e-9, 1e-12, 1.0, 1e8])
    @pytest.mark.parametrize("full_well", [1.0, 1e5, 1e8])
    @needs_more_than_half
    def test_feature_extremes_stay_finite_with_finite_gradients(self, device, wide, value, full_well):
        sensor = SensorNoise(0.0, full_well=full_well, dark=0.0, clip=False)
        image = torch.full((1, 1, 16, 16), value, device=device, dtype=wide)
        out = sensor(image)
        assert out.isfinite().all()
        assert gradient_of(sensor, image).isfinite().all()
        if value <= 0:
            assert (out == 0).all()

    @given(
        hnp.arrays(
            np.float32, hnp.array_shapes(min_dims=4, max_dims=4, max_side=3), elements=st.floats(-1e6, 1e6, width=32)
        )
    )
    @settings(max_examples=50)
    @pytest.mark.filterwarnings("ignore:image holds:UserWarning")
    def test_property_without_noise_it_is_a_clamp(self, array):
        assert np.array_equal(SensorNoise(0.0)(torch.from_numpy(array)).numpy(), np.clip(array, 0, 1))


class TestSensorNoiseCompiled(BaseTester):
    @staticmethod
    def check(device, dtype, backend: str, tolerance: float) -> None:
        """One graph, equal to eager on pixels of both branches of the shot noise."""
        torch._dynamo.reset()
        sensor = SensorNoise.physical(full_well=60, read_noise_electrons=2, dark_electrons=1, bits=12)
        image = torch.rand(2, 3, 16, 16, device=device, dtype=dtype)
        params = sensor.draw(image.shape, device=device)
        compiled = torch.compile(sensor, fullgraph=True, backend=backend)
        assert (compiled(image, params) - sensor(image, params)).abs().max() <= tolerance
        expected = gradient_of(lambda x: sensor(x, params), image)
        torch.testing.assert_close(gradient_of(lambda x: compiled(x, params), image), expected)

    def test_dynamo_graph_is_whole_and_equal(self, device, dtype):
        self.check(device, dtype, "aot_eager", tolerance=0.0)

    @pytest.mark.slow
    @needs_compiler
    @pytest.mark.filterwarnings("ignore::DeprecationWarning")  # raised inside PyTorch while it loads inductor
    def test_dynamo_inductor_is_equal_to_one_level(self, device):
        self.check(device, torch.float32, "inductor", tolerance=1.01 / 4095)
