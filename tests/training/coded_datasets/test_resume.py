from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.base import BaseTester
from tests.training.coded_datasets.killed_renders import COUNT, FORMS
from tests.training.coded_datasets.samples import contents

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """The folder that processes were killed over, and what they tell."""
    folder = tmp_path_factory.mktemp("killed")
    command = [sys.executable, "-m", "tests.training.coded_datasets.killed_renders", str(folder), "3"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.slow
class TestResume(BaseTester):
    @pytest.mark.parametrize("name", FORMS)
    def test_feature_processes_killed_at_random_moments_end_with_the_bytes_of_one_undisturbed(self, name, killed):
        """One, two and three processes by turns, with one job or two; and three at once that nobody kills."""
        folder, told = killed
        there = told["there"][name]
        assert 0 < there[0] < len(FORMS[name].parts(COUNT)), f"the first kill did not come in the middle: {there}"
        whole = contents(folder / f"{name}-whole")
        assert contents(folder / f"{name}-three") == whole
        assert contents(folder / f"{name}-killed") == whole, f"killed when parts were there: {there}"

    @pytest.mark.parametrize("name", FORMS)
    def test_feature_the_work_of_a_lost_process_is_taken_over(self, name, killed):
        folder, _ = killed
        assert contents(folder / f"{name}-lost") == contents(folder / f"{name}-whole")

    def test_feature_jobs_do_not_outlive_the_process_that_is_killed(self, killed):
        """While they start, and while they wait to hand over a capture; else they would for ever."""
        assert killed[1]["ended"] == {"first fork": True, "second fork": True, "first capture": True}
