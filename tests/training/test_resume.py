from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from kornia_tidy.reconstruction.state_file import read_state
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")
ROOT = Path(__file__).resolve().parents[2]


def leaves(state, place=""):
    """All tensors and values of a nested state, by their place."""
    if isinstance(state, dict):
        return {k: v for name, part in state.items() for k, v in leaves(part, f"{place}/{name}").items()}
    if isinstance(state, (list, tuple)):
        return {k: v for i, part in enumerate(state) for k, v in leaves(part, f"{place}/{i}").items()}
    return {place: state.tolist() if isinstance(state, torch.Tensor) else state}


def lines(path):
    """A log without the time that steps took."""
    return [line.split(",")[:3] for line in path.read_text().splitlines()]


class TestResume(BaseTester):
    @pytest.mark.slow
    def test_feature_a_run_killed_at_random_moments_ends_bit_for_bit_where_an_undisturbed_one_does(self, tmp_path):
        """Masks, network with dropout and batch normalisation, moving average, Adam, generators, counters, logs.

        Killed while it pretrains, between the stages, in a step, writing the log or a checkpoint, and in validation.
        """
        command = [sys.executable, "-m", "tests.training.killed_runs", str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 0, done.stderr
        steps = json.loads(done.stdout)
        assert steps["pretraining"] is steps["between the stages"] is None
        assert 0 < steps["validation"] < 15, f"no kill came in the middle of the run: {steps}"
        for stage in (".", "pretrain"):
            whole, killed = (tmp_path / name / stage for name in ("whole", "killed"))
            for name in ("last.safetensors", "best.safetensors"):
                one, other = leaves(read_state(whole / name)), leaves(read_state(killed / name))
                assert name.startswith("best") or one["/global_step"] == (15 if stage == "." else 5)
                assert one == other, f"{stage}, killed at steps {steps}"
            for name in ("training.csv", "validation.csv"):
                assert lines(whole / name) == lines(killed / name), f"{stage}, killed at steps {steps}"
