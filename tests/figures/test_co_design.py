from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.design import Candidate, CoDesign, DesignTask, Finalist, Verdict
from kornia_tidy.design.candidates import FLAT
from kornia_tidy.figures.co_design import draw_co_design
from tests.base import BaseTester

FLAT_50 = Candidate(FLAT, 50.0, 0.5, 0.0210, math.nan, -16.8, None)
CODED = [
    Candidate("focal sweep", f, 0.5, error, math.nan, -18.0, torch.rand(2, 23, 23))
    for f, error in ((22, 0.014), (25, 0.015))
]


def finalist(candidate, scores):
    return Finalist(candidate, {"image": "capture"}, scores[0], tuple(scores), scores[0], math.nan)


@pytest.fixture(scope="module")
def figure():
    flat, first, second = (
        finalist(FLAT_50, [27.0, 28.0]),
        finalist(CODED[0], [29.0, 30.0]),
        finalist(CODED[1], [28.0, 28.0]),
    )
    verdict = Verdict(flat, first, 2.0, 0.25, 2)
    return draw_co_design(
        CoDesign(DesignTask(masks=2), (FLAT_50, *CODED), (flat, first, second), verdict, "two masks win")
    )


class TestDrawCoDesign(BaseTester):
    def test_feature_the_search_shows_every_candidate(self, figure):
        points = {line.get_label(): line.get_xydata().tolist() for line in figure.axes[0].get_lines()}
        assert points["flat lens"] == [[50.0, 0.0210]]
        assert points["masks, focal sweep"] == [[22, 0.014], [25, 0.015]]

    def test_feature_the_scores_are_those_of_the_second_half(self, figure):
        axes = figure.axes[1]
        points = {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
        assert points["flat lens"] == [[50.0, 27.5]]
        assert points["masks"] == [[22, 29.5], [25, 28.0]]
        low, high = axes.collections[0].get_segments()[0][:, 1]
        assert (low, high) == pytest.approx((29.0, 30.0))  # two standard errors on either side

    def test_feature_the_words_masks_and_psfs_are_there(self, figure):
        assert figure.texts[0].get_text() == "Two masks win"
        assert len(figure.axes) == 2 + 2 + 2 * 7
