"""sRGB as operators: their error over the whole range, what is no light, derivatives, and the ways around C."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from kornia_tidy.kernels import pixel_ops
from kornia_tidy.kernels.pixel_ops import SOURCE, decode, encode
from tests.base import BaseTester
from tests.kernels import kernel_shapes
from tests.kernels.kernel_shapes import srgb_by_definition
from tests.kernels.operator_tester import OperatorTester, needs_compiler

JOINTS = {False: 0.04045, True: 0.0031308}
PAIRS = {False: (decode, rgb_to_linear_rgb), True: (encode, linear_rgb_to_rgb)}


class TestSRGB(OperatorTester):
    draw = staticmethod(kernel_shapes.srgb)
    differentiable = (0,)
    source = SOURCE

    def smallest(self):
        return torch.ops.kornia_tidy.srgb(torch.zeros(1), False)

    @needs_compiler
    @pytest.mark.parametrize("encode", [False, True])
    def test_feature_error_in_float32_over_the_whole_range(self, encode):
        """Every 97th float32 from 2**-24 to 1, and all those beside the joint and 1."""
        first, joint, last = torch.tensor([2.0**-24, JOINTS[encode], 1.0]).view(torch.int32).tolist()
        beside = (torch.arange(near - 2000, near + 1) for near in (joint, joint + 2000, last))
        x = torch.cat([torch.arange(first, last, 97), *beside]).int().view(torch.float32)
        off = (torch.ops.kornia_tidy.srgb(x, encode) - srgb_by_definition(x.double(), encode)).abs()
        assert off.max() <= 2e-7

    @needs_compiler
    @pytest.mark.parametrize("encode", [False, True])
    def test_gradcheck_twice(self, encode):
        x = torch.tensor([-0.2, 0.0, 0.001, 0.2, 0.9, 3.0], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(torch.ops.kornia_tidy.srgb, (x, encode))
        assert torch.autograd.gradgradcheck(torch.ops.kornia_tidy.srgb, (x, encode))

    def test_exception(self):
        with pytest.raises(TypeError, match=r"values must be float32 or float64, got .*float16"):
            torch.ops.kornia_tidy.srgb(torch.zeros(2, dtype=torch.half), False)


class TestSRGBGradient(OperatorTester):
    draw = staticmethod(kernel_shapes.srgb_gradient)
    source = SOURCE

    def smallest(self):
        return torch.ops.kornia_tidy.srgb(torch.zeros(1), False, torch.zeros(1))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"fields must be .*32 of shape \(2,\) as the values, got .*64 of"):
            torch.ops.kornia_tidy.srgb(torch.zeros(2), False, torch.zeros(1).double())


@pytest.mark.parametrize("encode", [False, True])
class TestConversions(BaseTester):
    def test_feature_border_cases_as_kornia_has_them(self, encode, dtype, device):
        """And the slopes of finite ones: at 0 and at the joints those of the line."""
        ours, theirs = PAIRS[encode]
        joint = torch.tensor(JOINTS[encode], dtype=dtype)
        ends = [torch.nextafter(joint, torch.tensor(end, dtype=dtype)).item() for end in (0.0, 1.0)]
        cases = [0.0, -0.0, joint.item(), *ends, 1.0, -1.0, 1e4, -1e4, math.inf, -math.inf, math.nan]
        x = torch.tensor(cases, dtype=dtype, device=device).expand(3, 1, -1)
        rtol = 16 * torch.finfo(dtype).eps
        self.assert_close(ours(x).nan_to_num(nan=-7), theirs(x).nan_to_num(nan=-7), rtol=rtol, atol=0)
        finite = x[..., :-3].clone().requires_grad_()
        slopes = [torch.autograd.grad(function(finite).sum(), finite)[0] for function in (ours, theirs)]
        self.assert_close(*slopes, rtol=rtol, atol=0)

    @pytest.mark.parametrize("shape", [(), (0,), (7,), (2, 1, 4, 5), (2, 3, 4, 5), (0, 3, 4, 5), (1, 2, 0)])
    @pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
    def test_cardinality(self, encode, shape, kind):
        made = PAIRS[encode][0](torch.rand(shape).to(kind))
        assert (made.shape, made.dtype) == (torch.Size(shape), kind)

    def test_feature_the_order_of_memory_stays(self, encode):
        x = torch.rand(2, 3, 5, 7).to(memory_format=torch.channels_last)
        ours = PAIRS[encode][0]
        assert ours(x).is_contiguous(memory_format=torch.channels_last)
        assert torch.equal(ours(x), ours(x.contiguous()))

    def test_feature_without_a_compiler_it_is_what_kornia_does(self, encode, monkeypatch):
        monkeypatch.setattr(pixel_ops, "compiled", lambda source, dtype: None)
        ours, theirs = PAIRS[encode]
        x = torch.rand(2, 3, 5, 7)
        assert torch.equal(ours(x), theirs(x))
        assert torch.equal(ours(x[:, :1]), theirs(x[:, :1].expand(-1, 3, -1, -1))[:, :1])

    def test_dynamo(self, encode):
        ours = PAIRS[encode][0]
        compiled = torch.compile(ours, fullgraph=True, backend="aot_eager")
        x = torch.rand(3, 2, 5, dtype=torch.float64, requires_grad=True)
        slopes = [torch.autograd.grad(function(x).square().sum(), x)[0] for function in (ours, compiled)]
        self.assert_close(*slopes)
