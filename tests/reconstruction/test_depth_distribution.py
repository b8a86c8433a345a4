"""Distributions of depth: their moments, their loss, and the temperature that makes them true."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.reconstruction.depth_distribution import (
    ERROR_WEIGHT,
    depth_moments,
    distribution_loss,
    fit_temperature,
    layer_weights,
    soft_targets,
)
from tests.base import BaseTester
from tests.rounding import gamma


def logits_of(probabilities, pixels=1, dtype=torch.float64):
    """Logits of one distribution at all pixels of a row, (1, D, 1, pixels)."""
    return torch.tensor(probabilities, dtype=dtype).log().view(1, -1, 1, 1).expand(1, -1, 1, pixels).clone()


class TestDepthMoments(BaseTester):
    @pytest.mark.parametrize(("mean", "deviation"), [(0.43, 0.05), (0.61, 0.08)])
    def test_feature_a_gaussian_keeps_its_moments_between_the_classes(self, mean, deviation):
        """Sampled three times a deviation and cut at five, as Poisson's sum and erfc(5 / sqrt(2)) = 6e-7 bound it."""
        centres = torch.linspace(0, 1, 65, dtype=torch.float64).view(1, -1, 1, 1)
        found = depth_moments(-0.5 * ((centres - mean) / deviation).square())
        self.assert_close(found[0].squeeze(), torch.tensor(mean).double(), atol=1e-5, rtol=0)
        self.assert_close(found[1].squeeze(), torch.tensor(deviation).double(), atol=1e-5, rtol=0)

    @pytest.mark.parametrize("classes", [2, 3, 32])
    def test_feature_where_nothing_is_known_the_deviation_is_that_of_a_uniform_distribution(self, classes, dtype):
        mean, deviation = depth_moments(torch.zeros(1, classes, 1, 1, dtype=dtype))
        self.assert_close(mean.squeeze(), torch.tensor(0.5))
        self.assert_close(deviation.squeeze(), torch.tensor(math.sqrt((classes + 1) / (classes - 1) / 12)))

    def test_feature_a_sure_pixel_has_a_gradient_without_nan(self):
        logits = torch.tensor([1e4, 0.0, 0.0]).view(1, 3, 1, 1).requires_grad_()
        depth_moments(logits)[1].sum().backward()
        assert logits.grad.isfinite().all()

    def test_gradcheck(self, device):
        self.gradcheck(depth_moments, (torch.rand(1, 4, 2, 2, device=device),))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"needs 2 classes or more, got logits \(1, 1, 2, 2\)"):
            depth_moments(torch.rand(1, 1, 2, 2))
        with pytest.raises(TypeError, match="logits"):
            depth_moments(torch.zeros(1, 3, 2, 2, dtype=torch.int64))


class TestLayerWeights(BaseTester):
    @pytest.mark.parametrize("layers", [2, 5, 11, 40])
    def test_feature_layers_have_the_mean_depth_of_the_distribution(self, layers):
        logits = 3 * torch.randn(2, 17, 3, 4, dtype=torch.float64)
        weights = layer_weights(logits, layers)
        assert weights.shape == (2, layers, 3, 4)
        assert (weights >= 0).all()
        self.assert_close(weights.sum(1), torch.ones(2, 3, 4).double(), atol=gamma(4 * layers, torch.float64), rtol=0)
        places = torch.linspace(0, 1, layers, dtype=torch.float64).view(-1, 1, 1)
        self.assert_close((weights * places).sum(1, keepdim=True), depth_moments(logits)[0], atol=1e-12, rtol=0)


class TestSoftTargets(BaseTester):
    def test_feature_they_are_the_two_nearest_classes_and_their_mean_is_the_depth(self):
        depth = torch.rand(1, 1, 5, 7, dtype=torch.float64)
        targets = soft_targets(depth, 9)
        assert ((targets > 0).sum(1) <= 2).all()
        centres = torch.linspace(0, 1, 9, dtype=torch.float64).view(-1, 1, 1)
        self.assert_close((targets * centres).sum(1, keepdim=True), depth, atol=1e-12, rtol=0)

    def test_feature_depths_beyond_the_range_have_its_ends(self):
        targets = soft_targets(torch.tensor([-3.0, 7.0]).view(1, 1, 1, 2), 4)
        assert targets[0, :, 0].T.tolist() == [[1, 0, 0, 0], [0, 0, 0, 1]]


class TestDistributionLoss(BaseTester):
    def test_feature_it_is_cross_entropy_and_expected_error_less_half_the_spread(self):
        """By sums over all classes, and all pairs of them."""
        probabilities, depth = torch.tensor([0.1, 0.2, 0.4, 0.3], dtype=torch.float64), 1 / 3  # the second class
        centres = torch.linspace(0, 1, 4, dtype=torch.float64)
        error = (probabilities * (centres - depth).abs()).sum()
        spread = (probabilities[:, None] * probabilities * (centres[:, None] - centres).abs()).sum()
        expected = -probabilities[1].log() + ERROR_WEIGHT * (error - spread / 2)
        loss = distribution_loss(logits_of(probabilities.tolist()), torch.full((1, 1, 1, 1), depth).double())
        self.assert_close(loss, expected, atol=1e-6, rtol=0)  # 1 / 3 in float32

    def test_feature_it_is_least_for_the_true_distribution(self):
        """Both scores are proper: over depths of these frequencies the gradient is zero there, and not elsewhere."""
        depth = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 1.0, 1.0]).double().view(1, 1, 1, 8)

        def gradient(probabilities):
            logits = logits_of(probabilities).requires_grad_()
            (found,) = torch.autograd.grad(distribution_loss(logits.expand(1, 3, 1, 8), depth), logits)
            return found.abs().max()

        assert gradient([0.5, 0.25, 0.25]) < 1e-12
        assert gradient([0.4, 0.3, 0.3]) > 1e-2

    def test_feature_unknown_depths_have_no_part_in_loss_and_gradient(self):
        logits = torch.randn(1, 5, 2, 3, requires_grad=True)
        depth, mask = torch.rand(1, 1, 2, 3), torch.rand(1, 1, 2, 3) > 0.4
        mask[..., 0] = torch.tensor([True, False])
        known = torch.stack([distribution_loss(logits[..., [y], :][..., [x]], depth[..., [y], :][..., [x]])
                             for y, x in mask[0, 0].nonzero().tolist()])  # fmt: skip
        loss = distribution_loss(logits, depth.where(mask, torch.nan), mask)
        loss.backward()
        self.assert_close(loss.detach(), known.mean().detach())
        assert (logits.grad.movedim(1, -1)[~mask[:, 0]] == 0).all()

    def test_feature_without_known_depth_it_is_zero(self):
        logits = torch.randn(1, 5, 2, 3, requires_grad=True)
        loss = distribution_loss(logits, torch.full((1, 1, 2, 3), torch.nan), torch.zeros(1, 1, 2, 3, dtype=torch.bool))
        loss.backward()
        assert loss == 0
        assert (logits.grad == 0).all()

    def test_gradcheck(self, device):
        depth = torch.rand(1, 1, 2, 2, dtype=torch.float64, device=device)
        self.gradcheck(lambda logits: distribution_loss(logits, depth), (torch.rand(1, 4, 2, 2, device=device),))


class TestFitTemperature(BaseTester):
    @pytest.mark.parametrize("temperature", [0.25, 1.0, 3.0])
    def test_feature_it_finds_by_how_much_distributions_are_too_narrow(self, temperature):
        depth = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 1.0, 1.0]).double().view(1, 1, 1, 8)
        logits = temperature * logits_of([0.5, 0.25, 0.25], 8)
        assert fit_temperature(logits, depth) == pytest.approx(temperature, rel=1e-6)

    def test_feature_unknown_depths_do_not_count(self):
        depth = torch.tensor([0.0, 0.0, 1.0, torch.nan]).view(1, 1, 1, 4)
        logits = logits_of([0.8, 0.2], 4, torch.float32)
        expected = fit_temperature(logits[..., :3], depth[..., :3])
        assert fit_temperature(logits, depth, ~depth.isnan()) == expected
        assert fit_temperature(logits, depth, torch.zeros_like(depth, dtype=torch.bool)) == 1.0
