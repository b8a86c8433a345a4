"""The decoding process many times over, without starting an interpreter for each: one that has imported all, and forks.

It reads lines of JSON (file to read, file to write, seconds, bytes of memory) and answers each with an exit status, or
null after killing what took too long. It has decoded nothing itself when it forks, so no thread is lost in a fork.
"""

import json
import os
import signal
import sys
import time


def main():
    paths, folder = json.loads(sys.argv[1]), sys.argv[2]
    sys.path[:] = [folder, *paths]
    import decoder

    sys.path[:] = paths
    import numpy as np  # noqa: F401
    import rawpy  # noqa: F401

    while line := os.read(0, 1 << 16):
        source, result, timeout, memory = json.loads(line)
        child = os.fork()
        if not child:
            sys.argv[1:] = [json.dumps(paths), str(int(timeout) + 1), str(memory)]
            _point(source, result)
            try:
                decoder.main()
            except BaseException:
                os._exit(1)
            os._exit(0)
        os.write(1, json.dumps(_status(child, time.monotonic() + timeout)).encode() + b"\n")


def _point(source, result):
    for number, path, flags in ((0, source, os.O_RDONLY), (1, result, os.O_WRONLY), (2, os.devnull, os.O_WRONLY)):
        os.dup2(os.open(path, flags), number)
    sys.stdin = os.fdopen(0)


def _status(child, deadline):
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.001)


if __name__ == "__main__":
    main()
