"""What importing the library costs, and what it leaves alone: each claim in an interpreter of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.base import BaseTester

TIMED = """
import time
import cv2, kornia, torch
start = time.perf_counter()
import kornia_tidy
print(time.perf_counter() - start)
"""

HEAVY = ("colour", "matplotlib", "rawpy", "h5py", "lightning", "torch._dynamo")
LISTED = f"""
import sys
import cv2, kornia, torch
before = set(sys.modules)
import kornia_tidy
print(*(name for name in {HEAVY} if name in sys.modules and name not in before))
"""


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def imported():
    return python("-W", "error", "-c", LISTED)


class TestImport(BaseTester):
    def test_feature_import_is_silent_with_warnings_as_errors(self, imported):
        assert (imported.returncode, imported.stderr) == (0, "")

    def test_feature_heavy_packages_are_left_until_they_are_needed(self, imported):
        assert imported.stdout.strip() == ""

    def test_feature_import_adds_less_than_a_fifth_of_a_second(self):
        """Over kornia, torch and cv2; the best of up to three runs, as the machine may be busy."""
        seconds = []
        for _ in range(3):
            seconds.append(float(python("-c", TIMED).stdout))
            if seconds[-1] < 0.2:
                return
        raise AssertionError(f"import kornia_tidy added {min(seconds):.3f} s at best")
