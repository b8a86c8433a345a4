from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from kornia_tidy.lab.raw import decoding
from kornia_tidy.lab.raw.decoding import DECODER, decode_raw
from tests.base import BaseTester
from tests.lab.raw.dng import dng

DATA = dng(np.random.default_rng(0).integers(64, 1000, (36, 48)))
# What decoders said under limits of 60 to 200 MiB: Python, LibRaw, the linker that loads NumPy, and OpenBLAS.
OUT_OF_MEMORY = (
    'print(\'{"error": "MemoryError"}\')',
    'print(\'{"error": "LibRawError", "text": "std::bad_alloc"}\')',
    'print(\'{"error": "ImportError", "text": "Original error was: libopenblas.so: failed to map segment from '
    "shared object\"}')",
    "sys.exit('OpenBLAS error: Memory allocation still failed after 10 retries, giving up.')",
    "raise MemoryError",
    'print(\'{"error": "SystemError", "text": "numpy.int64 returned a result with an exception set"}\')',
)
LOADED = "sys.stderr.write('loaded\\n')"  # what the decoder says before it looks at a file
PEAK = """
import json, runpy, sys
runpy.run_path(sys.argv.pop(1), run_name="__main__")
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
sys.stderr.write(status["VmPeak"].split()[0])
"""


class TestDecodeRaw(BaseTester):
    @pytest.fixture
    def decoder_that(self, tmp_path, monkeypatch):
        """Let another program take the decoder's place."""

        def install(program):
            path = tmp_path / "decoder.py"
            path.write_text("import os, signal, sys, time\n" + program)
            monkeypatch.setattr(decoding, "DECODER", path)

        return install

    def test_smoke(self):
        header, counts, length = decode_raw(DATA, 60, 2**31)
        assert (header["letters"], counts.shape, length) == (["RG", "GB"], (1, 36, 48), len(DATA))

    def test_feature_the_process_imports_no_torch(self):
        """Nor anything else of ours or of the sort: NumPy, rawpy and the standard library."""
        arguments = [sys.executable, "-X", "importtime", "-I", "-S", str(DECODER), json.dumps(sys.path), "60"]
        told = subprocess.run([*arguments, str(2**31)], input=DATA, capture_output=True, check=True)
        names = {line.rsplit("|", 1)[1].strip() for line in told.stderr.decode().splitlines() if "|" in line}
        tops = {name.split(".")[0] for name in names}
        assert {"numpy", "rawpy"} <= tops
        assert tops - set(sys.stdlib_module_names) <= {
            "numpy",
            "rawpy",
            "imported package",
            "org",
        }  # org: pickle asks for Jython

    @pytest.mark.parametrize(
        ("program", "reason"),
        [
            (f"{LOADED}; os.kill(os.getpid(), signal.SIGSEGV)", r"LibRaw crashed on it \(SIGSEGV\)"),
            (
                "os.kill(os.getpid(), signal.SIGSEGV)",
                r"crashed before it was loaded \(SIGSEGV\): is the 2048 MiB of memory that it may use too little\?",
            ),
            ("os.kill(os.getpid(), signal.SIGXCPU)", "more processor time than it may use"),
            (f"{LOADED}; os.abort()", r"LibRaw crashed on it \(SIGABRT\)"),
            (f"{LOADED}; sys.exit('no such\\nmodule')", r"its decoder failed \(no such module\)"),
            ("", "gave no complete picture"),
            ("print('not JSON')", "gave no complete picture"),
            ("print('[1, 2]')", "gave no complete picture"),
            ("print('{\"shape\": [2, 2, 1]}'); print('1234567', end='')", "gave no complete picture"),
            ("print('{\"shape\": [-1, -4, 1]}'); print('12345678', end='')", "gave no complete picture"),
            ("print('{\"shape\": \"22\"}'); print('12345678', end='')", "gave no complete picture"),
            *((program, "needs more than the 2048 MiB of memory that it may use") for program in OUT_OF_MEMORY),
        ],
    )
    def test_exception_whatever_happens_is_one_sentence(self, program, reason, decoder_that):
        decoder_that(program)
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of {len(DATA)} bytes: [^\n]*{reason}"):
            decode_raw(DATA, 60, 2**31)

    def test_exception_a_hang_ends_in_time_and_nothing_is_left_running(self, decoder_that, tmp_path):
        pid = tmp_path / "pid"
        decoder_that(f"open({str(pid)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)")  # longer than a test may take
        with pytest.raises(ValueError, match=r"decoding took longer than 1\.5 s"):
            decode_raw(DATA, 1.5, 2**31)
        if pid.exists() and pid.read_text():  # else it was ended before it came so far
            with pytest.raises(ProcessLookupError):
                os.kill(int(pid.read_text()), 0)

    @pytest.mark.skipif(sys.platform != "linux", reason="the limit of memory is the system's")
    def test_exception_memory_is_bounded(self):
        """A file of 24 megapixels needs 46 MiB, its counts as much, and Python, NumPy and LibRaw their own memory."""
        arguments = [sys.executable, "-I", "-S", "-c", PEAK, str(DECODER), json.dumps(sys.path), "60", str(2**31)]
        told = subprocess.run(
            arguments, input=DATA, capture_output=True, check=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        )
        limit = int(told.stderr.split()[-1]) * 1024 + 32 * 2**20
        assert decode_raw(DATA, 60, limit)[1].shape == (1, 36, 48)
        large = dng(np.random.default_rng(0).integers(64, 1000, (4000, 6000), dtype=np.uint16))
        with pytest.raises(ValueError, match=f"needs more than the {limit / 2**20:.0f} MiB of memory"):
            decode_raw(large, 60, limit)
        assert decode_raw(large, 60, limit + 128 * 2**20)[1].shape == (1, 4000, 6000)

    @pytest.mark.parametrize(("timeout", "memory_limit"), [(0, 2**31), (60, 0), (float("nan"), 2**31)])
    def test_exception_limits(self, timeout, memory_limit):
        with pytest.raises(ValueError, match="must be positive and finite"):
            decode_raw(DATA, timeout, memory_limit)
