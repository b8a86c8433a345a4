"""RawCapture.open with a fork of one decoder process that has imported NumPy and rawpy, in a tenth of the time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from kornia_tidy.lab.raw import decoder, decoding


@contextmanager
def forked_decoding():
    """Replace the decoder process of RawCapture.open by a fork, with the same limits, decoder and reader."""
    command = [sys.executable, "-I", "-S", Path(__file__).with_name("decoding_forks.py"), json.dumps(sys.path)]
    command.append(decoding.DECODER.parent)
    before = decoding._run
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:

        def run(file, result, timeout, memory_limit):
            paths = [f"/proc/{os.getpid()}/fd/{one.fileno()}" for one in (file, result)]
            server.stdin.write(json.dumps([*paths, timeout, memory_limit]).encode())
            server.stdin.flush()
            status = json.loads(server.stdout.readline())
            if status is None:
                raise subprocess.TimeoutExpired("decoder", timeout)
            return status, decoder.LOADED  # its server loaded all before it forked

        decoding._run = run
        try:
            yield
        finally:
            decoding._run = before
            server.stdin.close()
