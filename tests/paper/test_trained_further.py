"""Shipped systems that are trained further: what changes, what does not, and what is compared with what."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from examples.paper import boundaries_training, switching_training, trained_further
from examples.paper.cameras import camera_with
from examples.paper.scenes import BUDGETS
from examples.paper.sequence_length import first_masks
from examples.paper.shipped import load_shipped
from examples.paper.training import mean_scores
from kornia_tidy import Switching
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")
pytestmark = pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")
GATHER = boundaries_training.CONDITIONS
TINY = replace(trained_further.BUDGETS["smoke"], steps=1, scored=1)


class TestTrials(BaseTester):
    @pytest.mark.parametrize("module", [switching_training, boundaries_training])
    def test_feature_each_system_has_a_control_with_as_many_steps(self, module):
        trials = module.trials("cpu")
        for system in {trial["system"] for trial in trials}:
            trained = [trial["trained"] for trial in trials if trial["system"] == system]
            assert trained.count(trained_further.AS_SHIPPED) == 1
            control = "0 ms" if module is switching_training else "gather"
            assert trained.count(control) == trained_further.BUDGETS["cpu"].seeds

    def test_feature_states_in_training_change_and_are_never_those_that_are_scored(self):
        optics = camera_with(first_masks(3, "edof", 0), BUDGETS["smoke"].fidelity, modulator=Switching(4e-3))
        scored = switching_training.SWAPS["4 ms"](torch.zeros(3, 23, 23))[0]
        seen = [scored]
        for step in range(3):
            switching_training.other_patterns(optics, step)
            states = optics.modulator(torch.zeros(3, 23, 23))[0]
            assert not any(torch.equal(states, other) for other in seen)
            seen.append(states)
        assert optics.modulator.switching_time == 4e-3


class TestCrossedScores(BaseTester):
    @pytest.mark.slow  # .ci/run runs it
    def test_smoke_a_shipped_system_keeps_its_scores_and_a_trained_one_does_not(self, monkeypatch):
        monkeypatch.setitem(trained_further.BUDGETS, "smoke", TINY)
        trial = {"system": "joint-1", "trained": trained_further.AS_SHIPPED, "seed": "0"}
        shipped = trained_further.crossed_scores(trial, "smoke", GATHER, ["gather"])
        system = load_shipped("joint-1")
        optics = trained_further.with_parts(system.optics)
        scene = trained_further.painted(TINY, "test", TINY.scored)
        direct = mean_scores(trained_further.system_of(optics, system.head, system.settings, system.step), scene)
        assert shipped["network_gather_painted_psnr"] == direct["psnr"]
        further = trained_further.crossed_scores({**trial, "trained": "occlusion"}, "smoke", GATHER, ["gather"])
        assert further["network_gather_painted_psnr"] != direct["psnr"]
        assert further["closed_gather_painted_psnr"] != shipped["closed_gather_painted_psnr"]  # its masks moved
