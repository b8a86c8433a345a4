"""The picture of reconstructions."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from kornia_tidy.figures.estimates import Estimate, draw_estimates
from tests.base import BaseTester


def scene():
    torch.manual_seed(0)
    return torch.rand(3, 24, 32), torch.rand(1, 24, 32)


class TestDrawEstimates(BaseTester):
    def test_smoke_the_picture_has_a_row_an_estimate(self):
        image, inverse_depth = scene()
        estimates = [Estimate(f"K = {k}", image, image, inverse_depth) for k in (1, 3, 5)]
        figures = [draw_estimates(image, inverse_depth, estimates[:count]) for count in (2, 3)]
        assert figures[1].get_figheight() > figures[0].get_figheight()
        assert sum(axes.axison for axes in figures[1].axes) == 17  # the third row needs no scene beside it
        stored = BytesIO()
        figures[0].savefig(stored, dpi=50)
        assert np.asarray(Image.open(stored)).std() > 10

    def test_feature_scores(self):
        image, inverse_depth = scene()
        estimate = Estimate("K = 5", image - 0.1, image * 0.5 + 0.25, inverse_depth * 0.5)
        scores = estimate.scores(image, inverse_depth)
        assert scores["capture_psnr"] == pytest.approx(20, abs=1e-3)
        error = (image * 0.5 - 0.25).square().mean()
        assert scores["image_psnr"] == pytest.approx(-10 * float(error.log10()), abs=1e-3)

        assert scores["depth_rmse"] == pytest.approx(float((inverse_depth * 0.5).square().mean().sqrt()), rel=1e-5)

    def test_feature_an_estimate_without_depth_leaves_its_places_empty(self):
        image, inverse_depth = scene()
        estimates = [Estimate("K = 1", image, image, inverse_depth), Estimate("edof", image, image, None)]
        assert "depth_rmse" not in estimates[1].scores(image, inverse_depth)
        shown = [axes.axison for axes in draw_estimates(image, inverse_depth, estimates).axes]
        assert shown == 6 * [True] + 4 * [True] + 2 * [False]

    def test_feature_a_told_uncertainty_is_a_last_column(self):
        image, inverse_depth = scene()
        told = Estimate("told", image, image, inverse_depth, 0.1 + 0 * inverse_depth)
        figure = draw_estimates(image, inverse_depth, [told, Estimate("K = 1", image, image, inverse_depth)])
        assert [axes.axison for axes in figure.axes] == 7 * [True] + 6 * [True] + [False]
        np.testing.assert_allclose(figure.axes[6].images[0].get_array(), 0.3, atol=1e-6)

    def test_exception_one_estimate_is_no_comparison(self):
        image, inverse_depth = scene()
        with pytest.raises(ValueError, match="compares two estimates or more, got 1"):
            draw_estimates(image, inverse_depth, [Estimate("K = 5", image, image, inverse_depth)])
