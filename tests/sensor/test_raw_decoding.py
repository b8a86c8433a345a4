from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from kornia_tidy.sensor import raw_decoding
from kornia_tidy.sensor.raw_decoding import DECODER, decode_raw
from tests.base import BaseTester
from tests.sensor.dng import dng

DATA = dng(np.random.default_rng(0).integers(64, 1000, (36, 48)))


class TestDecodeRaw(BaseTester):
    @pytest.fixture
    def decoder_that(self, tmp_path, monkeypatch):
        """Let another program take the decoder's place."""

        def install(program):
            path = tmp_path / "decoder.py"
            path.write_text("import os, signal, sys, time\n" + program)
            monkeypatch.setattr(raw_decoding, "DECODER", path)

        return install

    def test_smoke(self):
        header, counts, length = decode_raw(DATA, 60, 2**31)
        assert (header["pattern"], counts.shape, length) == ([[0, 1], [3, 2]], (1, 36, 48), len(DATA))

    def test_feature_the_process_imports_no_torch(self):
        """Nor anything else of ours or of the sort: NumPy, rawpy and the standard library."""
        arguments = [sys.executable, "-X", "importtime", "-I", "-S", str(DECODER), json.dumps(sys.path), "60"]
        told = subprocess.run([*arguments, str(2**31)], input=DATA, capture_output=True, check=True)
        names = {line.rsplit("|", 1)[1].strip() for line in told.stderr.decode().splitlines() if "|" in line}
        tops = {name.split(".")[0] for name in names}
        assert {"numpy", "rawpy", "raw_tags"} <= tops
        assert tops - set(sys.stdlib_module_names) <= {
            "numpy",
            "rawpy",
            "raw_tags",
            "imported package",
            "org",
        }  # org: pickle asks for Jython

    @pytest.mark.parametrize(
        ("program", "reason"),
        [
            ("os.kill(os.getpid(), signal.SIGSEGV)", r"LibRaw crashed on it \(SIGSEGV\)"),
            ("os.kill(os.getpid(), signal.SIGXCPU)", "more processor time than it may use"),
            ("os.abort()", r"LibRaw crashed on it \(SIGABRT\)"),
            ("sys.exit('no such\\nmodule')", r"its decoder failed \(no such module\)"),
            ("", "gave no complete picture"),
            ("print('not JSON')", "gave no complete picture"),
            ("print('[1, 2]')", "gave no complete picture"),
            ("print('{\"shape\": [2, 2, 1]}'); print('1234567', end='')", "gave no complete picture"),
            ("print('{\"shape\": [-1, -4, 1]}'); print('12345678', end='')", "gave no complete picture"),
            ("print('{\"shape\": \"22\"}'); print('12345678', end='')", "gave no complete picture"),
            ('print(\'{"error": "MemoryError"}\')', "needs more than the 2048 MiB of memory that it may use"),
        ],
    )
    def test_exception_whatever_happens_is_one_sentence(self, program, reason, decoder_that):
        decoder_that(program)
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of {len(DATA)} bytes: [^\n]*{reason}"):
            decode_raw(DATA, 60, 2**31)

    def test_exception_a_hang_ends_in_time_and_nothing_is_left_running(self, decoder_that, tmp_path):
        decoder_that(f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)")
        start = time.perf_counter()
        with pytest.raises(ValueError, match=r"decoding took longer than 1\.5 s"):
            decode_raw(DATA, 1.5, 2**31)
        assert time.perf_counter() - start < 20
        pid = (tmp_path / "pid").read_text()
        if pid:
            with pytest.raises(ProcessLookupError):
                os.kill(int(pid), 0)

    @pytest.mark.skipif(sys.platform != "linux", reason="the limit of memory is the system's")
    def test_exception_memory_is_bounded(self):
        large = dng(np.random.default_rng(0).integers(64, 1000, (4000, 6000), dtype=np.uint16))
        with pytest.raises(ValueError, match="needs more than the 140 MiB of memory"):
            decode_raw(large, 60, 140 * 2**20)

    @pytest.mark.parametrize(("timeout", "memory_limit"), [(0, 2**31), (60, 0), (float("nan"), 2**31)])
    def test_exception_limits(self, timeout, memory_limit):
        with pytest.raises(ValueError, match="must be positive and finite"):
            decode_raw(DATA, timeout, memory_limit)
