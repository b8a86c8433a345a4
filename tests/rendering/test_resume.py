from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from kornia_tidy.rendering import Layout
from tests.base import BaseTester
from tests.rendering.killed_renders import COUNT
from tests.rendering.samples import contents

ROOT = Path(__file__).resolve().parents[2]


class TestResume(BaseTester):
    def test_feature_processes_killed_at_random_moments_end_with_the_bytes_of_one_undisturbed(self, tmp_path):
        """One, two and three processes by turns, with one job or two; and three at once that nobody kills."""
        command = [sys.executable, "-m", "tests.rendering.killed_renders", str(tmp_path), "3"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        for name, layout in (("folders", Layout()), ("shards", Layout(shard_items=4))):
            parts = len(layout.parts(COUNT))
            assert any(0 < there < parts for there in told[name]), f"no kill came in the middle: {told[name]}"
            whole = contents(tmp_path / f"{name}-whole")
            assert contents(tmp_path / f"{name}-three") == whole
            assert contents(tmp_path / f"{name}-killed") == whole, f"killed when parts were there: {told[name]}"
