from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, torch
from kornia_tidy.render.backends.allocator import keep_memory
torch.set_num_threads(1)
keep_memory()
def work():
    blocks = [torch.ones(5 << 20, dtype=torch.uint8) for _ in range(4)]
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults() -> int:
    """Pages that a process of its own fetches for ten times four blocks of 5 MiB, after the first time."""
    usual = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    run = subprocess.run([sys.executable, "-c", FAULTS], env=usual, capture_output=True, text=True, check=True)
    return int(run.stdout)


class TestKeepMemory:
    @pytest.mark.takes_seconds
    @pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
    def test_feature_pages_are_fetched_once(self):
        """51,200 pages of 4 KiB are written. Where memory is given back most are fetched anew, up to 49,578.

        How much is kept depends on what else the process holds: 1,280 to 7,680 are fetched.
        """
        assert faults() < 51_200 // 2
