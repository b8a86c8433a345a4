from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from kornia_tidy.cli import main
from kornia_tidy.reconstruction.state_file import read_state
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
class TestTwoProcesses(BaseTester):
    def test_feature_two_processes_are_one_that_accumulates_two_batches(self, tmp_path):
        """After 20 steps, masks included; the network has no batch normalisation, whose statistics would differ."""
        states = []
        for processes in (1, 2):
            folder = tmp_path / str(processes)
            script = ROOT / "tests" / "training" / "two_processes.py"
            done = subprocess.run(
                [sys.executable, str(script), str(folder), str(processes)],
                capture_output=True,
                text=True,
                cwd=ROOT,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            assert ("MEMBER: 2/2" in done.stderr) == (processes == 2)
            states.append(read_state(folder / "last.safetensors"))
            assert len(states[-1]["callbacks"]["SaveCheckpoints"]["random"]) == processes
        one, two = states
        assert one["global_step"] == two["global_step"] == 20
        start = (tmp_path / "1" / "training.csv").read_text()
        assert start != (tmp_path / "2" / "training.csv").read_text()  # the first process sees its own batches only
        for name, weight in one["state_dict"].items():
            self.assert_close(weight, two["state_dict"][name], rtol=0, atol=1e-5)

    def test_feature_from_the_command_line_with_pretraining_and_a_resume_by_torchrun(self, tmp_path):
        """Lightning starts the second process itself, once for both stages; torchrun's go on with what they left."""
        small = ["--head", "plain", "--width", "4", "--size", "48", "--scenes", "6", "--validation-scenes", "2"]
        small += ["--masks", "2", "--fidelity", "draft", "--border", "replicate", "--lr", "1e-3", "--batch", "1"]
        stages = ["--pretrain-epochs", "1", "--epochs"]
        assert main(["train", *small, *stages, "2", "--accumulate", "2", "-o", str(tmp_path / "one")]) == 0
        two = ["--devices", "2", "-o", str(tmp_path / "two")]
        torchrun = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "kornia_tidy"]
        for command in (
            ["kornia_tidy", "train", *small, *stages, "1", *two],
            [*torchrun, "train", "--resume", "--epochs", "2", *two],
        ):
            done = subprocess.run(
                [sys.executable, "-m", *command], capture_output=True, text=True, cwd=ROOT, check=False
            )
            assert done.returncode == 0, done.stderr
            assert done.stdout.count("evaluate this one") == 1, done.stdout
        one, two = (read_state(tmp_path / name / "last.safetensors") for name in ("one", "two"))
        assert one["global_step"] == two["global_step"] == 6
        for name, weight in one["state_dict"].items():
            self.assert_close(weight, two["state_dict"][name], rtol=0, atol=1e-5)
