from __future__ import annotations

import pytest
import torch

from kornia_tidy.kernels.precision import safe_sqrt
from kornia_tidy.reconstruction.validity import valid_maps
from tests.base import BaseTester


class TestValidMaps(BaseTester):
    def test_feature_nan_and_infinity_behind_the_mask_reach_neither_values_nor_gradients(self, device, dtype):
        prediction = torch.tensor([1.0, float("inf"), float("nan"), 4.0], device=device, dtype=dtype).view(1, 1, 2, 2)
        target = torch.tensor([0.5, float("nan"), 2.0, float("nan")], device=device, dtype=dtype).view(1, 1, 2, 2)
        mask = torch.tensor([True, False, False, False], device=device).view(1, 1, 2, 2)
        prediction.requires_grad_()
        shown, truth, _ = valid_maps(prediction, target, mask, filler=7.0)
        assert shown.flatten().tolist() == [1.0, 7.0, 7.0, 7.0]
        assert truth.flatten().tolist() == [0.5, 7.0, 7.0, 7.0]
        (gradient,) = torch.autograd.grad((shown * truth).sum(), prediction)
        assert gradient.flatten().tolist() == [0.5, 0.0, 0.0, 0.0]

    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_feature_half_is_compared_in_float32_and_nothing_below_the_better_of_two(self, device, half):
        maps = {
            kind: torch.ones(1, 1, 2, 2, device=device, dtype=kind) for kind in (half, torch.float32, torch.float64)
        }
        for kinds, expected in (
            ((half, half), torch.float32),
            ((half, torch.float32), torch.float32),
            ((torch.float64, half), torch.float64),
        ):
            shown, truth, _ = valid_maps(*[maps[kind] for kind in kinds])
            assert (shown.dtype, truth.dtype) == (expected, expected)

    @pytest.mark.parametrize("shape", [(1, 1, 4, 5), (2, 1, 4, 5), (2, 3, 4, 5), (1, 1, 1, 5), (2, 1, 1, 1)])
    def test_cardinality_masks_broadcast(self, device, shape):
        maps = torch.rand(2, 2, 3, 4, 5, device=device)
        mask = torch.rand(shape, device=device) > 0.5
        shown, _, whole = valid_maps(maps[0], maps[1], mask)
        assert whole.shape == (2, 3, 4, 5)
        assert torch.equal(shown != 0, mask.expand(2, 3, 4, 5))

    def test_exception_shapes_that_would_broadcast_are_refused(self, device):
        depth = torch.zeros(4, 1, 8, 8, device=device)
        with pytest.raises(ValueError, match=r"the target's shape \(4, 1, 8, 8\), got \(4, 4, 8, 8\)"):
            valid_maps(torch.zeros(4, 4, 8, 8, device=device), depth)
        with pytest.raises(ValueError, match=r"prediction must have shape \(B, C, H, W\), got \(4, 8, 8\)"):
            valid_maps(torch.zeros(4, 8, 8, device=device), depth)

    @pytest.mark.parametrize("shape", [(4, 8, 8), (3, 1, 8, 8), (4, 1, 8, 7)])
    def test_exception_the_mask_must_broadcast(self, device, shape):
        depth = torch.zeros(4, 1, 8, 8, device=device)
        with pytest.raises(ValueError, match=r"mask must broadcast to .* \(4, 1, 8, 8\), got"):
            valid_maps(depth, depth, torch.ones(shape, dtype=torch.bool, device=device))

    def test_exception_types(self, device):
        depth = torch.zeros(1, 1, 2, 2, device=device)
        with pytest.raises(TypeError, match=r"mask must be bool, .* got torch.float32"):
            valid_maps(depth, depth, torch.ones_like(depth))
        with pytest.raises(TypeError, match=r"target must be floating point, got torch.uint8"):
            valid_maps(depth, depth.to(torch.uint8))


class TestSafeSqrt(BaseTester):
    def test_feature_zero_has_no_gradient_and_nan_stays(self, device):
        value = torch.tensor([0.0, 9.0, float("nan")], device=device, requires_grad=True)
        root = safe_sqrt(value)
        assert root[:2].tolist() == [0.0, 3.0]
        assert root[2].isnan()
        (gradient,) = torch.autograd.grad(root[:2].sum(), value)
        self.assert_close(gradient[:2], torch.tensor([0.0, 1 / 6], device=device))
