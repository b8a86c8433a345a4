"""Recording as an operator: against the definition, the bits of the definition in torch, derivatives, ways around C."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from kornia_tidy.kernels import pixel_ops
from kornia_tidy.kernels.pixel_ops import SOURCE, record
from kornia_tidy.sensor import SensorNoise
from tests.base import BaseTester
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import OperatorTester, needs_compiler

SENSORS = {
    "read": SensorNoise(0.03),
    "bits": SensorNoise(0.03, bits=8),
    "unclipped": SensorNoise(0.03, bits=3, clip=False),
    "dim": SensorNoise(0.03, full_well=20.0, dark=2.0),
    "bright": SensorNoise(0.03, full_well=5000.0, dark=2.0),
    "bright in bits": SensorNoise.physical(5000, 3, bits=10),
}

NOTHING = (1.0, 0.0, 0.0, 0, True)  # well, dark signal, read noise, bits, clipped


@pytest.fixture
def by_torch(monkeypatch):
    """A sensor without the operator."""

    def made(sensor, light, params):
        with monkeypatch.context() as patch:
            patch.setattr(pixel_ops, "compiled", lambda source, dtype: None)
            return sensor(light, params)

    return made


class TestRecord(OperatorTester):
    draw = staticmethod(kernel_shapes.sensor)
    differentiable = (0,)
    source = SOURCE

    def smallest(self):
        return torch.ops.kornia_tidy.record(torch.zeros(1), *[None] * 3, *NOTHING)

    def test_exception(self):
        with pytest.raises(TypeError, match=r"values must be float32 or float64, got .*float16"):
            torch.ops.kornia_tidy.record(torch.zeros(2).half(), *[None] * 3, *NOTHING)

    @needs_compiler
    def test_gradcheck_twice(self):
        light = torch.tensor([-0.2, 0.3, 0.5, 0.8], dtype=torch.float64, requires_grad=True)
        uniform = torch.tensor([0.3, 0.4, 0.9, 0.2], dtype=torch.float64)
        for well in (200.0, 5000.0):
            assert torch.autograd.gradcheck(lambda x, w=well: record(x, uniform, full_well=w), light)
            assert torch.autograd.gradgradcheck(lambda x, w=well: record(x, uniform, full_well=w), light)

    @needs_compiler
    def test_feature_the_normal_quantile_over_the_whole_range(self):
        """To 8 roundings in float32 and to 16 in float64, beside 0 and 1 too."""
        for dtype, roundings in ((torch.float32, 8), (torch.float64, 16)):
            eps = torch.finfo(dtype).eps
            ends = eps * torch.logspace(-0.6, 13, 400, dtype=torch.float64)
            u = (
                torch.cat([ends, 1 - ends, torch.linspace(0.01, 0.99, 999).double()])
                .to(dtype)
                .clamp(eps / 4, 1 - eps / 2)
            )
            rate = torch.full_like(u, 25.0)
            drawn = record(rate, u).double() - 25
            expected = 5 * torch.from_numpy(stats.norm.ppf(u.double().numpy()))
            seen = expected > -25  # electrons are not negative
            allowed = roundings * eps / 2 * (25 + 2 * expected.abs())
            assert bool(((drawn - expected).abs() <= allowed)[seen].all())


class TestRecordGradient(OperatorTester):
    draw = staticmethod(kernel_shapes.sensor_gradient)
    source = SOURCE

    def smallest(self):
        return torch.ops.kornia_tidy.record(torch.zeros(1), *[None] * 3, 1.0, 0.0, 0.0, 0, True, torch.zeros(1))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"fields must be .*32 of shape \(2,\) as the values, got .*64 of"):
            torch.ops.kornia_tidy.record(torch.zeros(2), *[None] * 3, 1, 0, 0, 0, True, torch.zeros(1).double())

    @needs_compiler
    def test_exception_a_gradient_has_no_gradient(self):
        light = torch.zeros(2, requires_grad=True)
        found = torch.ops.kornia_tidy.record(light, *[None] * 3, 1, 0, 0, 0, True, torch.zeros(2))
        with pytest.raises(NotImplementedError, match="a gradient has no gradient here: differentiate functions of"):
            found.sum().backward()


@needs_compiler
class TestSameNoise(BaseTester):
    @pytest.mark.parametrize("kind", ["read", "bits", "unclipped", "dim"])
    @pytest.mark.parametrize("wide", [torch.float32, torch.float64])
    def test_feature_bit_for_bit_as_without_a_compiler(self, kind, wide, by_torch):
        sensor, light = SENSORS[kind], 1.2 * torch.rand(2, 3, 67, 45, dtype=wide) - 0.1
        params = sensor.draw(light.shape, dtype=wide)
        assert torch.equal(sensor(light, params), by_torch(sensor, light, params))

    @pytest.mark.parametrize("wide", [torch.float32, torch.float64])
    def test_feature_many_electrons_to_rounding(self, wide, by_torch):
        sensor, light = SENSORS["bright"], 1.2 * torch.rand(2, 3, 67, 45, dtype=wide) - 0.1
        params = sensor.draw(light.shape, dtype=wide)
        self.assert_close(
            sensor(light, params), by_torch(sensor, light, params), rtol=0, atol=8 * torch.finfo(wide).eps
        )

    def test_feature_many_electrons_in_bits_to_a_level_of_a_few(self, by_torch):
        """Those whose value lies within rounding, some 1e-7 of 1, beside the step of 1e-3 between two levels."""
        sensor, light = SENSORS["bright in bits"], torch.rand(1, 3, 300, 400)
        params = sensor.draw(light.shape)
        off = (sensor(light, params) - by_torch(sensor, light, params)).abs() * 1023
        assert float(off.max()) < 1.01
        assert float((off > 0.5).float().mean()) < 1e-3

    def test_feature_what_is_no_number_stays_none(self):
        light = torch.tensor([torch.nan, torch.inf, -torch.inf])
        field = torch.full_like(light, 0.7)
        for well in (None, 20.0, 5000.0):
            seen = record(light, None if well is None else field, field, full_well=well or 1.0, sigma=0.1, clip=True)
            assert seen.isnan().tolist() == [True, False, False]

    def test_feature_maps_that_are_learnt_have_gradients(self):
        offset = torch.zeros(1, 1, requires_grad=True)
        sensor = SensorNoise(0.0, offset=offset.detach())
        sensor.offset = offset
        sensor(torch.full((1, 1, 4, 4), 0.5)).sum().backward()
        assert offset.grad.item() == 16

    def test_dynamo(self):
        light, uniform = torch.rand(3, 5, requires_grad=True), torch.rand(3, 5)
        compiled = torch.compile(record, fullgraph=True, backend="aot_eager")
        pairs = [(f(light, uniform, full_well=900.0),) for f in (record, compiled)]
        pairs = [(made, *torch.autograd.grad(made.sum(), light)) for (made,) in pairs]
        for one, other in zip(*pairs, strict=True):
            self.assert_close(one, other)
