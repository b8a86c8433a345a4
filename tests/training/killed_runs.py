"""Train in child processes that are killed at random moments and go on; told as JSON. Run by test_resume.py.

Children are forks of this process, so that only it waits for imports.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
import warnings
from pathlib import Path

import torch
from torch import nn

from kornia_tidy.training import heads, run
from kornia_tidy.training.settings import TrainingSettings
from kornia_tidy.training.state_file import read_state

SETTINGS = TrainingSettings(
    task="joint", masks=2, width=4, size=64, scenes=20, validation_scenes=2, batch=2, accumulate=2, epochs=4, window=23,
    head="dropout", lr=1e-3, seed=3,
)  # fmt: skip


class DropoutHead(heads.PlainHead):
    """A network that draws from torch's global generator, and keeps statistics."""

    def __init__(self, out_channels: int = 3, width: int = 4) -> None:
        super().__init__(out_channels, width)
        self.noise, self.norm = nn.Dropout(0.2), nn.BatchNorm2d(3)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return super().forward(self.noise(self.norm(image)))


def child(folder: Path) -> int:
    process = os.fork()
    if process == 0:
        code = 1
        try:
            run.train(SETTINGS, folder, resume=True, save_every=1)
            code = 0
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(code)
    return process


def wait(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def main(folder: Path, kills: int) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", DeprecationWarning)  # of fork in a process that has threads
    heads.HEADS["dropout"] = "__main__:DropoutHead"
    assert wait(child(folder / "whole")) == 0
    chance, killed_at = random.Random(time.time_ns()), []
    for kill in range(kills):
        done, room = reached(folder), 19 // kills
        process = child(folder / "killed")
        target = min(done + chance.randrange(1, room), 20)
        while reached(folder) < target:
            time.sleep(0.005)
            assert not os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT), "it ended by itself"
        time.sleep(chance.uniform(0, 0.05))  # into a later step, a save of it, or validation
        os.kill(process, signal.SIGKILL)
        assert wait(process) in {0, -signal.SIGKILL}, f"kill {kill} came too late for a run that failed"
        killed_at.append(reached(folder))
    assert wait(child(folder / "killed")) == 0
    print(json.dumps(killed_at))


def reached(folder: Path) -> int:
    """The step of the last checkpoint of the run that is killed."""
    last = folder / "killed" / "last.safetensors"
    return read_state(last)["global_step"] if last.exists() else 0


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
