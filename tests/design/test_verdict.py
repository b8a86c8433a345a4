from __future__ import annotations

import math
import statistics

import pytest
import torch

from kornia_tidy.design import DesignTask
from kornia_tidy.design.candidates import FLAT, Candidate
from kornia_tidy.design.verdict import decide, finalist, in_words
from tests.base import BaseTester

FLAT_50 = Candidate(FLAT, 50.0, 0.5, 0.02, math.nan, -17.0, None)
FLAT_15 = Candidate(FLAT, 15.0, 0.5, 0.02, math.nan, -17.0, None)
CODED = Candidate("focal sweep", 22.0, 0.5, 0.014, math.nan, -18.5, torch.zeros(5, 3, 3))


def scored(candidate, decibels, task=None):
    """Return a finalist with one setting."""
    return finalist(task or DesignTask(), candidate, [{"image": {"only": value}} for value in decibels])


class TestFinalist(BaseTester):
    def test_feature_settings_of_the_first_half_score_on_the_second(self):
        scores = [{"image": {"a": a, "b": b}} for a, b in ((30, 20), (1, 50), (30, 20), (3, 50))]
        one = finalist(DesignTask(), FLAT_50, scores)
        assert (one.settings, one.chosen_by, one.scores) == ({"image": "a"}, 30, (1, 3))

    def test_feature_image_and_depth_by_weight(self):
        scores = [{"image": {"a": 20.0}, "depth": {"x": 8.0, "y": 10.0}}] * 4
        one = finalist(DesignTask(depth_weight=0.25), FLAT_50, scores)
        assert one.settings == {"image": "a", "depth": "y"}
        assert one.score == pytest.approx(0.75 * 20 + 0.25 * 10)
        assert (one.image, one.depth) == pytest.approx((20, 10**-0.5))


class TestDecide(BaseTester):
    def test_feature_gain_and_standard_error_are_paired(self):
        flat, coded = scored(FLAT_50, [20, 20, 20, 30, 20, 10]), scored(CODED, [21, 21.5, 21, 31, 21, 12])
        verdict = decide([flat, coded])
        differences = [1.5, 1, 2]
        assert verdict.gain == pytest.approx(1.5)
        assert verdict.standard_error == pytest.approx(statistics.stdev(differences) / math.sqrt(3))
        assert verdict.coding_pays
        assert verdict.recommended is CODED

    def test_feature_within_two_standard_errors_the_flat_lens_is_recommended(self):
        verdict = decide([scored(FLAT_50, [20, 20, 20, 20]), scored(CODED, [21, 23, 21, 20.5])])
        assert 0 < verdict.gain < 2 * verdict.standard_error
        assert verdict.recommended is FLAT_50

    def test_feature_the_best_is_chosen_on_the_first_half_alone(self):
        """The second flat lens is better on the scenes that score, and must not be chosen by them."""
        flats = [scored(FLAT_50, [20, 10, 20, 10]), scored(FLAT_15, [19, 30, 19, 30])]
        assert decide([*flats, scored(CODED, [18, 18, 18, 18.5])]).flat.candidate is FLAT_50


class TestInWords(BaseTester):
    @pytest.mark.parametrize(
        ("flat", "coded", "words"),
        [
            ((FLAT_50, 20), 21.5, "five masks at f/22: +1.55 ± 0.05 dB over the best stopped-down lens (f/50)"),
            ((FLAT_15, 20), 21.5, "five masks at f/22: +1.55 ± 0.05 dB over the best flat lens (f/15)"),
            (
                (FLAT_50, 20),
                19.5,
                "at this light stop down to f/50: coding gains nothing (the best, five masks at f/22: -0.45 ± 0.05 dB)",
            ),
            (
                (FLAT_15, 20),
                19.5,
                "at this light take the flat lens at f/15: coding gains nothing (the best, five masks at f/22: -0.45 ± "
                "0.05 dB)",
            ),
        ],
    )
    def test_feature_says_what_to_do(self, flat, coded, words):
        task = DesignTask()
        verdict = decide([scored(flat[0], [flat[1]] * 4), scored(CODED, [coded, coded, coded, coded + 0.1])])
        assert in_words(task, verdict) == words
