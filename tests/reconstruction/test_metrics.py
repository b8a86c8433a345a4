from __future__ import annotations

import math

import kornia
import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from kornia_tidy.reconstruction.metrics import (
    abs_rel,
    defocus_scores,
    delta_accuracy,
    depth_scores,
    image_scores,
    log10_error,
    psnr,
    rmse,
    ssim,
)
from tests.base import BaseTester

METRICS = (rmse, psnr, ssim, abs_rel, log10_error, delta_accuracy)


def make_depths(shape=(3, 1, 24, 27), device="cpu", dtype=torch.float64):
    """Predicted and true depth of 0.5 to 3 m with NaN holes in one corner, and the mask of what is known."""
    prediction, target = 0.5 + 2.5 * torch.rand(2, *shape, device=device, dtype=dtype)
    mask = torch.ones(shape[0], 1, *shape[2:], dtype=torch.bool, device=device)
    mask[..., :9, :8] = torch.rand(9, 8, device=device) > 0.5
    return prediction, target.masked_fill(~mask, torch.nan), mask


def numpy_ssim(x: np.ndarray, y: np.ndarray, seen: np.ndarray) -> float:
    """Wang's SSIM of (H, W) images in [0, 1], written out: 11 Gaussian taps, sigma 1.5, whole windows only."""
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def mean(image):
        return correlate1d(correlate1d(image, taps, axis=0), taps, axis=1)[5:-5, 5:-5]

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    whole = np.lib.stride_tricks.sliding_window_view(seen, (11, 11)).all((-2, -1))
    return values[whole].mean()


def by_hand(metric, x, z, seen) -> float:
    """The metrics of one (C, H, W) image in NumPy, from their definitions."""
    if metric is ssim:
        filled = (np.where(seen, v, 0.0) for v in (x, z))
        return float(np.mean([numpy_ssim(a, b, seen[0]) for a, b in zip(*filled, strict=True)]))
    x, z = x[seen], z[seen]
    return float(
        {
            rmse: np.sqrt(np.mean((x - z) ** 2)),
            psnr: -10 * np.log10(np.mean((x - z) ** 2)),
            abs_rel: np.mean(np.abs(x / z - 1)),
            log10_error: np.mean(np.abs(np.log10(x / z))),
            delta_accuracy: np.mean(np.maximum(x / z, z / x) < 1.25),
        }[metric]
    )


@pytest.mark.parametrize("metric", METRICS)
class TestMetrics(BaseTester):
    @pytest.mark.parametrize("channels", [1, 3])
    def test_feature_equals_numpy_image_by_image(self, metric, channels, device, dtype):
        prediction, target, mask = make_depths((3, channels, 24, 27), device, dtype)
        value = metric(prediction, target, mask)
        arrays = [v.double().cpu().numpy() for v in (prediction, target)]
        seen = np.broadcast_to(mask.cpu().numpy(), arrays[0].shape)
        expected = [by_hand(metric, x, z, s) for x, z, s in zip(*arrays, seen, strict=True)]
        self.assert_close(value.double().cpu(), torch.tensor(expected, dtype=torch.float64))
        assert value.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)

    def test_feature_an_image_without_a_valid_pixel_scores_nan_and_the_others_do_not(self, metric, device, dtype):
        prediction, target, mask = make_depths(device=device, dtype=dtype)
        whole = metric(prediction, target, mask)
        mask[1] = False
        value = metric(prediction, target, mask)
        assert value.isnan().tolist() == [False, True, False]
        assert torch.equal(value[::2], whole[::2])

    def test_feature_no_image_has_no_score(self, metric, device):
        none = torch.ones(0, 1, 24, 27, device=device)
        assert metric(none, none).shape == (0,)

    def test_feature_a_nan_that_is_seen_is_not_hidden(self, metric, device):
        prediction, target, mask = make_depths(device=device)
        prediction[0, 0, 20, 20] = torch.nan
        value = metric(prediction, target, mask)
        if metric is delta_accuracy:  # which counts pixels that are right
            assert value.isfinite().all()
            return
        assert value.isnan().tolist() == [True, False, False]

    def test_feature_masked_pixels_have_exactly_no_gradient(self, metric, device):
        prediction, target, mask = make_depths(device=device)
        if metric is delta_accuracy:
            assert not metric(prediction.requires_grad_(), target, mask).requires_grad
            return
        prediction = prediction.masked_fill(~mask, torch.nan).requires_grad_()
        (gradient,) = torch.autograd.grad(metric(prediction, target, mask).sum(), prediction)
        assert gradient.isfinite().all()
        assert (gradient[~mask] == 0).all()
        assert (gradient[..., 12:, 12:] != 0).all()

    def test_feature_perfect_predictions(self, metric, device, dtype):
        _, target, mask = make_depths(device=device, dtype=dtype)
        best = {psnr: math.inf, ssim: 1.0, delta_accuracy: 1.0}.get(metric, 0.0)
        self.assert_close(metric(target, target, mask), torch.full((3,), best, device=device, dtype=torch.float64))

    def test_exception_shapes_and_types_are_those_of_valid_maps(self, metric, device):
        depth = torch.ones(2, 1, 12, 12, device=device)
        with pytest.raises(ValueError, match="prediction must have the target's shape"):
            metric(depth[:1], depth)
        with pytest.raises(TypeError, match="mask must be bool"):
            metric(depth, depth, depth)


class TestKornia(BaseTester):
    def test_feature_single_images_score_what_kornia_gives(self, device, dtype):
        x, z = torch.rand(2, 2, 3, 32, 30, device=device, dtype=dtype)
        expected = torch.stack([kornia.metrics.psnr(a.double(), b.double(), 1.0) for a, b in zip(x, z, strict=True)])
        self.assert_close(psnr(x, z), expected)
        maps = kornia.metrics.ssim(x.double(), z.double(), 11, eps=0.0, padding="valid")
        self.assert_close(ssim(x, z), maps.mean((1, 2, 3)))

    def test_feature_scores_follow_the_data_range(self, device):
        x, z = torch.rand(2, 1, 1, 16, 16, device=device, dtype=torch.float64)
        self.assert_close(psnr(255 * x, 255 * z, max_value=255), psnr(x, z))
        self.assert_close(ssim(255 * x, 255 * z, max_value=255), ssim(x, z))

    def test_exception_ssim_of_a_small_image(self, device):
        small = torch.zeros(1, 1, 10, 30, device=device)
        with pytest.raises(ValueError, match=r"at least 11 pixels a side, got \(10, 30\)"):
            ssim(small, small)


class TestDepth(BaseTester):
    @pytest.mark.parametrize("metric", [abs_rel, log10_error, delta_accuracy, depth_scores])
    @pytest.mark.parametrize("bad", [0.0, -1.0, float("inf"), float("nan")])
    def test_exception_true_depths_name_the_bad_value(self, metric, bad, device):
        target = torch.tensor([1.0, bad], device=device).view(1, 1, 1, 2)
        with pytest.raises(ValueError, match=f"depths must be positive and finite, got {bad} .mark holes in the mask"):
            metric(torch.ones_like(target), target)

    def test_feature_predictions_of_zero_and_below_are_wrong_and_nothing_divides_by_them(self, device, dtype):
        prediction = torch.tensor([[0.0, 1.0], [-1.0, 1.0]], device=device, dtype=dtype).view(2, 1, 1, 2)
        target = torch.ones_like(prediction)
        assert delta_accuracy(prediction, target).tolist() == [0.5, 0.5]
        assert log10_error(prediction, target).tolist() == [math.inf, math.inf]
        assert abs_rel(prediction, target).tolist() == [0.5, 1.0]

    @pytest.mark.parametrize(("factor", "right"), [(1.24, 1), (1 / 1.24, 1), (1.26, 0), (1 / 1.26, 0), (1.25, 0)])
    def test_feature_delta_is_symmetric_and_strict(self, factor, right, device):
        target = torch.full((1, 1, 2, 2), 2.0, device=device, dtype=torch.float64)
        assert delta_accuracy(factor * target, target).item() == right

    def test_feature_scores_have_all_names_and_are_the_functions(self, device):
        maps = make_depths(device=device)
        scores = depth_scores(*maps)
        assert list(scores) == ["rmse", "abs_rel", "log10", "delta1", "delta2", "delta3"]
        assert torch.equal(scores["delta3"], delta_accuracy(*maps, threshold=1.953125))
        assert scores["delta1"].mean() < scores["delta2"].mean() < scores["delta3"].mean()
        images = image_scores(*maps)
        assert list(images) == ["rmse", "psnr", "ssim"]
        assert torch.equal(images["psnr"], psnr(*maps))

    def test_feature_both_scales_of_defocus_maps(self, device):
        """PhaseCam3D's 0.521 and a unit scale's 0.026 are the same error."""
        target = torch.full((1, 1, 4, 4), 0.3, device=device, dtype=torch.float64)
        scores = defocus_scores(target + 0.02605, target)
        assert round(scores["rmse_unit"].item(), 5) == 0.02605
        assert round(scores["rmse_radians"].item(), 3) == 0.521
        assert round(defocus_scores(target + 0.02605, target, span=40)["rmse_radians"].item(), 3) == 1.042
