"""Freed memory is given back to the system."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from kornia_tidy.reconstruction import reconstruct_tiled, tiled
from kornia_tidy.reconstruction.freed_memory import release_freed_memory
from tests.base import BaseTester

BLOCK, COUNT = 100_000, 2000  # bytes, too few for a mapping of its own; 200 MB together
STATISTICS = Path("/proc/self/statm")


def resident():
    return int(STATISTICS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class TestGiveBack(BaseTester):
    @pytest.mark.skipif(not STATISTICS.is_file(), reason="memory is read from Linux's /proc")
    def test_feature_freed_blocks_below_one_in_use_go_back(self):
        if not hasattr(ctypes.CDLL(None), "malloc_trim"):
            pytest.skip("the C library is not GNU's")
        release_freed_memory()
        blocks = [np.ones(BLOCK, np.uint8) for _ in range(COUNT)]
        full = resident()
        del blocks[:-1]
        release_freed_memory()
        assert full - resident() > 0.8 * BLOCK * COUNT

    def test_feature_after_tiles_not_after_one(self, monkeypatch):
        calls = []
        monkeypatch.setattr(tiled, "release_freed_memory", lambda: calls.append(1))
        head, image = nn.Conv2d(3, 1, 3, padding=1).eval(), torch.rand(1, 3, 64, 64)
        reconstruct_tiled(head, image)
        assert not calls
        reconstruct_tiled(head, image, tile=40, overlap=2)
        assert len(calls) == 1
