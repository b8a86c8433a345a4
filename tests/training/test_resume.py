from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from kornia_tidy.training.state_file import read_state
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
    def test_feature_a_run_killed_at_random_moments_ends_bit_for_bit_where_an_undisturbed_one_does(self, tmp_path):
        """Masks, network with dropout and batch normalisation, moving average, Adam, generators, counters, logs."""
        script = ROOT / "tests" / "training" / "killed_runs.py"
        done = subprocess.run(
            [sys.executable, str(script), str(tmp_path), "3"], capture_output=True, text=True, cwd=ROOT, check=False
        )
        assert done.returncode == 0, done.stderr
        steps = json.loads(done.stdout)
        assert any(0 < step < 20 for step in steps), f"no kill came in the middle of the run: {steps}"
        whole, killed = (tmp_path / name for name in ("whole", "killed"))
        for name in ("last.safetensors", "best.safetensors"):
            one, other = leaves(read_state(whole / name)), leaves(read_state(killed / name))
            assert one["/global_step"] == (20 if name.startswith("last") else one["/global_step"])
            assert one == other, f"killed at steps {steps}"
        for name in ("training.csv", "validation.csv"):
            assert lines(whole / name) == lines(killed / name)
