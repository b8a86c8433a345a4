"""A thousand damaged files, seeded: each gives a whole picture or one sentence, within its limits, and leaves nothing.

Each file is decoded in a process of its own as always, but forked from one that has imported NumPy and rawpy already: a
tenth of the time.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
import warnings

import numpy as np
import pytest

from kornia_tidy.lab.raw.capture import RawCapture
from tests.base import BaseTester, shared
from tests.lab.raw.dng_kinds import kind as dng_kind
from tests.lab.raw.forked import forked_decoding
from tests.mutations.damage import damaged

FILES = 1000
CHUNK = 100
SECONDS = 30.0
MEMORY = 2**30
SMALL = 1_000_000  # bytes; larger files are taken once in eight


def mutated(seed):
    """Return the name of the damage and the bytes of a damaged file: of the data, or in a third a small DNG."""
    generator = np.random.default_rng(seed)
    if generator.random() < 1 / 3:
        return damaged(dng_kind(seed).data, "raw", generator)
    folders = [shared(f"data/{name}", {"*": 1}) for name in ("raw", "raw_synthetic")]
    paths = [p for folder in folders for p in sorted(folder.rglob("*")) if p.is_file()]
    # Headerless dumps and files of other kinds are refused by their first bytes, whatever comes later.
    paths = [p for p in paths if p.stat().st_size > 1000 and p.parent.name[:6] not in {"mushfi", "cruxop", "drewno"}]
    large = [p for p in paths if p.stat().st_size > SMALL]
    small = [p for p in paths if p.stat().st_size <= SMALL]
    chosen = (large if generator.random() < 1 / 8 else small) or paths
    path = chosen[generator.integers(len(chosen))]
    return damaged(path.read_bytes(), "raw", generator)


def outcome(data):
    """Return a capture that was found whole, or the sentence of its refusal."""
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            raw = RawCapture.open(data, timeout=SECONDS, memory_limit=MEMORY)
    except ValueError as error:
        raw = str(error)
    assert time.perf_counter() - start < SECONDS + 30
    if isinstance(raw, str):
        assert re.fullmatch(r"cannot read the raw file of \d+ bytes: [^\n]{10,300}", raw), raw
        return raw
    channels, height, width = raw.counts.shape
    assert channels in {1, 3, 4}
    assert min(height, width) >= max(raw.tile)
    light = raw.mosaic()
    assert light.shape == raw.counts.shape
    assert light.isfinite().all()
    assert raw.upright(light).numel() == light.numel()
    return raw


class TestMutations(BaseTester):
    @pytest.mark.slow
    @pytest.mark.skipif(sys.platform != "linux", reason="files are passed on through /proc")
    @pytest.mark.timeout(1200)
    @pytest.mark.parametrize("first", range(0, FILES, CHUNK))
    def test_feature_a_whole_picture_or_one_sentence(self, first, tmp_path, monkeypatch):
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        with forked_decoding():
            told = [outcome(mutated(seed)[1]) for seed in range(first, first + CHUNK)]
        pictures = sum(isinstance(one, RawCapture) for one in told)
        assert 0 < pictures < CHUNK  # damage of both kinds is met
        assert os.listdir(tmp_path) == []

    def test_smoke_a_few(self):
        for seed in range(5):
            outcome(mutated(seed)[1])  # in an interpreter of its own each
