"""Train in child processes that are killed and go on; told as JSON. Run by test_resume.py.

Nothing here waits for a moment on the clock: a child kills itself on the way into a call that is chosen at random, or
after a random time of its own on the processor. Children are forks of this process, so that only it waits for imports.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from kornia_tidy.reconstruction import heads
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.training import callbacks, run
from kornia_tidy.training.module import TidyTraining
from kornia_tidy.training.settings import TrainingSettings
from tests.forks import fork, wait

SETTINGS = TrainingSettings(
    task="joint", masks=2, width=4, size=64, scenes=20, validation_scenes=2, batch=2, accumulate=2, epochs=3,
    pretrain_epochs=1, window=23, head="tests.training.killed_runs:DropoutHead", lr=1e-3, seed=3,
)  # fmt: skip


class DropoutHead(heads.PlainHead):
    """A network that draws from torch's global generator, and keeps statistics."""

    def __init__(self, in_channels: int = 3, out_channels: int = 3, width: int = 4) -> None:
        super().__init__(in_channels, out_channels, width)
        self.noise, self.norm = nn.Dropout(0.2), nn.BatchNorm2d(3)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return super().forward(self.noise(self.norm(image)))


def child(folder: Path, moment: Callable[[], object] = bool) -> int:
    """Train in a fork that something may happen to; return its exit code."""

    def trained() -> None:
        moment()
        run.train(SETTINGS, folder, resume=True, save_every=1)

    return wait(fork(trained))


def die_at(owner: Any, name: str, call: int) -> None:
    """Let this process be killed by the so manyth call of a function, before that does anything."""
    function, calls = getattr(owner, name), iter(range(1, call + 1))

    def fatal(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)

    setattr(owner, name, fatal)


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", DeprecationWarning)  # of fork in a process that has threads
    assert child(folder / "whole") == 0
    chance = random.Random(time.time_ns())
    moments = {
        "pretraining": partial(die_at, TidyTraining, "training_step", chance.randrange(1, 11)),
        "between the stages": partial(die_at, TidyTraining, "from_settings", 2),
        "a step": partial(die_at, TidyTraining, "training_step", chance.randrange(1, 8)),
        "a line of the log": partial(die_at, callbacks, "append_row", chance.randrange(1, 4)),
        "a file written but not in its place": partial(die_at, Path, "replace", chance.randrange(4, 8)),
        "validation": partial(die_at, TidyTraining, "validation_step", 1),
        "anywhere": partial(signal.setitimer, signal.ITIMER_PROF, chance.uniform(0.01, 1.0)),
    }
    reached = {}
    for name, moment in moments.items():
        code = child(folder / "killed", moment)
        assert code in {-signal.SIGKILL, -signal.SIGPROF} or (name == "anywhere" and code == 0), f"{name}: {code}"
        reached[name] = step(folder / "killed")
    assert child(folder / "killed") == 0
    print(json.dumps(reached))


def step(folder: Path) -> int | None:
    """The step of a run's last checkpoint; None if it has none."""
    last = folder / "last.safetensors"
    return read_state(last)["global_step"] if last.exists() else None


if __name__ == "__main__":
    main(Path(sys.argv[1]))
