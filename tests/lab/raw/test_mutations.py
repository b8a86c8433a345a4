"""A thousand damaged files, seeded: each gives a whole picture or one sentence, within its limits, and leaves nothing.

`python -m tests.lab.raw.test_mutations` prints how many of each there are. Each file is decoded in a process of its
own as always, but forked from one that has imported NumPy and rawpy already: a tenth of the time.
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

FILES = 1000
CHUNK = 100
SECONDS = 30.0
MEMORY = 2**30
SMALL = 1_000_000  # bytes; larger files are taken once in eight


def mutated(seed):
    """Return the name of a file and its bytes, damaged in one of five ways: of the data, or in a third a small DNG."""
    generator = np.random.default_rng(seed)
    if generator.random() < 1 / 3:
        return f"DNG {seed}", *damaged(generator, seed, dng_kind(seed).data)
    folders = [shared(f"data/{name}", {"*": 1}) for name in ("raw", "raw_synthetic")]
    paths = [p for folder in folders for p in sorted(folder.rglob("*")) if p.is_file()]
    # Headerless dumps and files of other kinds are refused by their first bytes, whatever comes later.
    paths = [p for p in paths if p.stat().st_size > 1000 and p.parent.name[:6] not in {"mushfi", "cruxop", "drewno"}]
    large = [p for p in paths if p.stat().st_size > SMALL]
    small = [p for p in paths if p.stat().st_size <= SMALL]
    chosen = (large if generator.random() < 1 / 8 else small) or paths
    path = chosen[generator.integers(len(chosen))]
    return path.name, *damaged(generator, seed, path.read_bytes())


def damaged(generator, seed, data):
    """Return the kind of damage and the bytes."""
    data = np.frombuffer(data, np.uint8).copy()
    kind = ("cut", "bytes", "header", "block", "zeros")[seed % 5]
    if kind == "cut":
        data = data[: generator.integers(1, len(data))]
    elif kind == "bytes":
        places = generator.integers(0, len(data), generator.integers(1, 65))
        data[places] = generator.integers(0, 256, len(places))
    elif kind == "header":
        places = generator.integers(4, min(2048, len(data)), generator.integers(1, 17))
        data[places] = generator.integers(0, 256, len(places))
    else:
        size = int(generator.integers(1, min(1 << 16, len(data))))
        start = generator.integers(0, len(data) - size)
        data[start : start + size] = 0 if kind == "zeros" else generator.integers(0, 256, size)
    return kind, data.tobytes()


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
            told = [outcome(mutated(seed)[2]) for seed in range(first, first + CHUNK)]
        pictures = sum(isinstance(one, RawCapture) for one in told)
        assert 0 < pictures < CHUNK  # damage of both kinds is met
        assert os.listdir(tmp_path) == []

    def test_smoke_one_of_each_kind(self):
        assert len({mutated(seed)[1] for seed in range(5)}) == 5
        for seed in range(5):
            outcome(mutated(seed)[2])  # in an interpreter of its own each


def count(first=0, last=FILES):
    """Print the outcomes, by kind of damage and by reason."""
    from collections import Counter

    kinds, reasons, slowest = Counter(), Counter(), 0.0
    for seed in range(first, last):
        name, kind, data = mutated(seed)
        start = time.perf_counter()
        told = outcome(data)
        seconds = time.perf_counter() - start
        slowest = max(slowest, seconds)
        whole = isinstance(told, RawCapture)
        kinds[kind, "picture" if whole else "sentence"] += 1
        reason = "picture" if whole else re.sub(r"-?\d[\d.e+]*", "N", told.split(": ", 1)[1])
        reasons[reason] += 1
        if "crashed" in reason or "failed" in reason or "longer" in reason or "memory" in reason or seconds > 5:
            print(seed, name, kind, f"{seconds:.1f} s", reason, flush=True)
    for key, number in [*sorted(kinds.items()), *reasons.most_common()]:
        print(number, key)
    print(f"slowest {slowest:.1f} s")


if __name__ == "__main__":
    with forked_decoding():
        count(*map(int, sys.argv[1:]))
    import resource

    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024  # of the server's own children too
    print(f"largest decoding process {peak:.0f} MiB")
