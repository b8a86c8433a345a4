from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction.losses import (
    gradient_loss,
    l1_loss,
    mse_loss,
    phasecam3d_loss,
    rmse_loss,
)
from tests.base import BaseTester

LOSSES = (mse_loss, l1_loss, rmse_loss, gradient_loss, phasecam3d_loss)


def make_maps(shape=(2, 3, 6, 7), device="cpu", dtype=torch.float64):
    """A prediction, a target with NaN holes, and the mask of what is known, of one channel."""
    prediction = torch.rand(shape, device=device, dtype=dtype)
    target = torch.rand(shape, device=device, dtype=dtype)
    mask = torch.rand(shape[0], 1, *shape[2:], device=device) > 0.3
    return prediction, target.masked_fill(~mask, torch.nan), mask


def by_hand(loss, prediction, target, mask) -> float:
    """The losses in NumPy, sample by sample."""
    x, z = (value.double().cpu().numpy() for value in (prediction, target))
    seen = np.broadcast_to(mask.cpu().numpy(), z.shape)
    error = x - z
    if loss is phasecam3d_loss:
        return 20 * by_hand(rmse_loss, prediction, target, mask) + by_hand(gradient_loss, prediction, target, mask)
    if loss is gradient_loss:
        rows = np.array([e for e in np.diff(error, axis=2).ravel() if not np.isnan(e)])  # NaN marks an unknown pixel
        columns = np.array([e for e in np.diff(error, axis=3).ravel() if not np.isnan(e)])
        return np.linalg.norm(rows) / len(rows) ** 0.5 + np.linalg.norm(columns) / len(columns) ** 0.5
    error = error[seen]
    return {
        mse_loss: np.linalg.norm(error) ** 2 / error.size,
        l1_loss: np.linalg.norm(error, 1) / error.size,
        rmse_loss: np.linalg.norm(error) / error.size**0.5,
    }[loss]


@pytest.mark.parametrize("loss", LOSSES)
class TestLosses(BaseTester):
    def test_feature_equals_numpy(self, loss, device, dtype):
        maps = make_maps(device=device, dtype=dtype)
        value = loss(*maps)
        assert value.shape == ()
        assert value.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
        self.assert_close(value.double().cpu(), torch.tensor(by_hand(loss, *maps), dtype=torch.float64))

    def test_feature_masked_pixels_have_exactly_no_gradient(self, loss, device, dtype):
        prediction, target, mask = make_maps(device=device, dtype=dtype)
        prediction.requires_grad_()
        (gradient,) = torch.autograd.grad(loss(prediction, target, mask), prediction)
        assert gradient.isfinite().all()
        hidden = ~mask.expand_as(gradient)
        assert (gradient[hidden] == 0).all()
        if loss is not gradient_loss:  # whose pixels may have no valid neighbour
            assert (gradient[~hidden] != 0).all()

    def test_feature_equal_maps_have_no_loss_and_a_finite_gradient(self, loss, device, dtype):
        target = torch.rand(1, 1, 4, 4, device=device, dtype=dtype)
        prediction = target.clone().requires_grad_()
        value = loss(prediction, target)
        assert value == 0
        assert (torch.autograd.grad(value, prediction)[0] == 0).all()

    def test_exception_an_empty_mask(self, loss, device):
        maps = torch.zeros(2, 1, 4, 5, device=device)
        with pytest.raises(ValueError, match=r"at least one valid (pixel|pair of pixels .*), got a mask .* with none"):
            loss(maps, maps, torch.zeros(2, 1, 4, 5, dtype=torch.bool, device=device))

    @pytest.mark.takes_seconds
    def test_dynamo_one_graph_and_an_empty_mask_has_no_loss(self, loss, device):
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        prediction, target, mask = make_maps(device=device, dtype=torch.float32)
        assert compiled(prediction, target, mask) == loss(prediction, target, mask)
        prediction.requires_grad_()
        value = compiled(prediction, target, torch.zeros_like(mask))
        assert value == 0
        assert (torch.autograd.grad(value, prediction)[0] == 0).all()


class TestGradientLoss(BaseTester):
    def test_feature_a_step_across_masked_pixels_is_not_an_edge(self, device, dtype):
        """Both sides are flat; what lies between is not known, so neither is the slope."""
        target = torch.tensor([1.0, 1.0, float("nan"), 5.0, 5.0], device=device, dtype=dtype).expand(1, 1, 3, 5)
        assert gradient_loss(torch.zeros_like(target), target, ~target.isnan()) == 0

    @pytest.mark.parametrize(("shape", "name"), [((1, 1, 4, 1), "beside"), ((1, 1, 1, 4), "above")])
    def test_exception_one_pixel_has_no_slope(self, device, shape, name):
        maps = torch.zeros(shape, device=device)
        with pytest.raises(ValueError, match=f"at least one valid pair of pixels {name} each other"):
            gradient_loss(maps, maps)
