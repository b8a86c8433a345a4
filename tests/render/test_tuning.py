from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kornia_tidy.render import tuning
from kornia_tidy.render.cost_model import seconds_of
from kornia_tidy.render.cost_profile import EPYC
from kornia_tidy.render.cost_store import KINDS
from kornia_tidy.render.dispatch import BACKENDS, refusal
from kornia_tidy.render.scene_samples import sample_scene
from kornia_tidy.render.tuning import (
    Case,
    Measurement,
    fit_profile,
    measure,
    prediction_errors,
    regrets,
    tuning_cases,
)
from tests.base import BaseTester

CASES = [
    Case(kind, 96, psf_size, layers, mode)
    for kind in KINDS
    for psf_size in (5, 9, 15, 23, 31, 41)
    for layers, mode in ((1, "nearest"), (4, "nearest"), (5, "linear"), (12, "linear"))
]
# A machine unlike EPYC in every backend and in how threads share.
TRUTH = replace(
    EPYC.scaled("truth", {"direct": 2.5, "tiled": 0.6, "occlusion_direct": 0.5, "occlusion_dense": 3.0}),
    dense=replace(EPYC.dense, shared=0.3, transform=0.4, blended=0.5),
)


@pytest.fixture(scope="module")
def measurements():
    """What the machine of ``TRUTH`` takes, exactly, on one thread and on two."""
    found = []
    for case in CASES:
        scene = sample_scene(case.side, case.psf_size, case.layers, case.mode, case.compositing)
        for backend in BACKENDS.values():
            if refusal(backend, scene) is None:
                work = backend.work(scene)
                found += [
                    Measurement(case, backend.name, work, threads, seconds_of(work, TRUTH, threads))
                    for threads in (1, 2)
                ]
    return found


class TestFit(BaseTester):
    def test_feature_a_machine_is_found_from_its_times(self, measurements):
        profile = fit_profile(EPYC, measurements, "found")
        assert profile.name == "found"
        assert profile.bank == EPYC.bank
        for own in prediction_errors(profile, measurements).values():
            assert 0.8 < own[0] <= own[-1] < 1.25  # the pull to the proportions of EPYC remains
        assert regrets(profile, measurements)[-1] < 1.15
        assert max(prediction_errors(EPYC, measurements)["dense"]) > 1.5

    def test_feature_how_threads_share_is_found(self, measurements):
        assert fit_profile(EPYC, measurements, "found").dense.shared == pytest.approx(0.3, abs=0.02)

    def test_feature_times_that_load_has_lengthened_are_passed_over(self, measurements):
        generator = np.random.default_rng(0)
        disturbed = [
            replace(one, seconds=one.seconds * (4.0 if generator.random() < 0.1 else 1.0)) for one in measurements
        ]
        profile = fit_profile(EPYC, disturbed, "found")
        for own in prediction_errors(profile, measurements).values():
            assert 0.85 < own[len(own) // 10] <= own[-len(own) // 10] < 1.15

    def test_feature_what_is_not_measured_stays(self, measurements):
        only = [one for one in measurements if one.work.rates == "tiled" and one.threads == 1]
        profile = fit_profile(EPYC, only, "found")
        assert profile.tiled.shared == EPYC.tiled.shared
        assert replace(profile, tiled=EPYC.tiled, name=EPYC.name) == EPYC

    def test_feature_prices_are_not_negative(self):
        """Times 1 = (1 + u) - u would have a price of -1."""
        u = np.linspace(0, 1, 40)
        found = tuning._solve(np.stack([1 + u, u], 1), np.full(2, 0.5))
        assert found[1] == 0
        assert 0.5 < found[0] < 1


class TestMeasure(BaseTester):
    def test_smoke_every_backend_of_every_case(self):
        cases = [Case("gather", 64, 5, 2, "linear"), Case("occlusion", 64, 5, 1, "nearest")]
        passed, before = [], torch.get_num_threads()
        found = measure(cases, seconds=0.5, threads=(1,), progress=passed.append)
        assert torch.get_num_threads() == before
        assert {one.case for one in found} == set(cases)
        assert all(0 < one.seconds < math.inf for one in found)
        assert passed == sorted(passed)
        assert 0 <= passed[0] <= passed[-1] <= 1

    def test_feature_ends_after_its_time(self, monkeypatch):
        clock = iter(range(1000))
        monkeypatch.setattr(tuning.time, "perf_counter", lambda: float(next(clock)))
        monkeypatch.setattr(tuning, "time_rendering", lambda *_: 1.0)
        assert len({one.case for one in measure(CASES, seconds=5, threads=(1,))}) == 5

    def test_feature_what_cannot_be_chosen_is_not_repeated(self, monkeypatch):
        timed = []
        monkeypatch.setattr(
            tuning,
            "time_rendering",
            lambda backend, _: timed.append(backend.name) or (9.0 if backend.name == "dense" else 1.0),
        )
        measure([Case("gather", 64, 5, 2, "linear")], seconds=60, threads=(1,))
        assert timed.count("dense") <= 2 < timed.count("tiled")

    def test_cardinality_cases_of_all_kinds(self):
        cases = tuning_cases()
        assert len(set(cases)) == len(cases)
        assert {case.compositing for case in cases} == set(KINDS)
        assert {case.mode for case in cases} == {"nearest", "linear"}

    def test_feature_regret_is_that_of_the_choice(self):
        case = Case("gather", 64, 5, 2, "linear")
        scene = sample_scene(64, 5, 2)
        tiled, dense = (BACKENDS[name].work(scene) for name in ("tiled", "dense"))
        times = [Measurement(case, "tiled", tiled, 1, 3.0), Measurement(case, "dense", dense, 1, 2.0)]
        chosen = seconds_of(tiled, EPYC) < seconds_of(dense, EPYC)
        assert regrets(EPYC, times) == [1.5 if chosen else 1.0]
        assert regrets(EPYC.scaled("x", {"tiled": 100.0}), times) == [1.0]
        assert regrets(EPYC.scaled("x", {"dense": 100.0}), times) == [1.5]
