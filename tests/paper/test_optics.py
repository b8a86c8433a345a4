"""The paper's experiments without training: they run, repeat, and compare what they say they compare."""

from __future__ import annotations

import importlib
import math

import pytest
import torch

from examples.paper import burst, theorem
from examples.paper.readme import EXPERIMENTS
from examples.paper.runner import ABOUT, main, run
from kornia_tidy.design.non_convexity import autocorrelation_bound, extreme_points
from kornia_tidy.optics import circular_aperture
from tests.base import BaseTester

NAMES = ("theorem", "switching_time", "boundaries", "burst")


@pytest.mark.parametrize("name", NAMES)
class TestEveryExperiment(BaseTester):
    @pytest.mark.slow  # .ci/run runs it
    def test_smoke_it_runs_and_says_what_it_can_and_cannot_judge(self, name, tmp_path, capsys):
        experiment = importlib.import_module(f"examples.paper.{name}").EXPERIMENT
        rows = main(experiment, "", ["--threads", "0", "--output", str(tmp_path)])
        assert len(rows) == len(experiment.trials("smoke"))
        text = (tmp_path / f"{name}-smoke.md").read_text(encoding="utf-8")
        assert text.startswith(f"## {EXPERIMENTS[name]}\n")
        assert "Judged can be" in text
        assert f"{len(rows)} of {len(rows)} trials" in text


@pytest.mark.parametrize("experiment", [theorem.EXPERIMENT, burst.EXPERIMENT], ids=["theorem", "burst"])
@pytest.mark.slow  # .ci/run runs it
def test_smoke_two_runs_print_the_same_digits(experiment, tmp_path):
    tables = []
    for name in ("once", "again"):
        folder = tmp_path / name
        folder.mkdir()
        rows = run(experiment, "smoke", folder, most=2)
        tables.append([{key: value for key, value in row.items() if key not in ABOUT} for row in rows])
    assert len(tables[0]) == 2
    assert tables[0] == tables[1]


class TestTheorem(BaseTester):
    def test_feature_the_bound_is_below_every_residual_of_a_single_mask_and_zero_for_one(self):
        aperture = circular_aperture(theorem.SIDE)
        scores = theorem.measure({"target": "five random masks", "fitted": "1", "seed": "0"}, "smoke")
        assert 0 < float(scores["bound"]) < float(scores["best"])
        own = theorem.average_psf(theorem.target_masks("one random mask", 0), aperture)
        assert theorem.least_residual(1.0, own, aperture) == 0.0

    def test_feature_the_bound_is_the_residual_where_only_the_extreme_lag_differs(self):
        """Two masks that differ at one extreme point: against either, other lags only add to the difference."""
        aperture = circular_aperture(theorem.SIDE)
        y, x = extreme_points(aperture)[0]
        pair = torch.zeros(2, theorem.SIDE, theorem.SIDE)
        pair[1, y, x] = math.pi
        target = theorem.average_psf(pair, aperture)
        single = theorem.average_psf(pair[:1], aperture)
        residual = float(((single - target).square().sum() / target.square().sum()).sqrt())
        bound = float(autocorrelation_bound(pair, aperture))
        assert bound == pytest.approx(0.0, abs=1e-6)
        assert 0 < theorem.least_residual(bound, target, aperture) < residual
