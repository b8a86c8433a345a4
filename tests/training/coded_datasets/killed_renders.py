"""Render by processes that are killed in the middle, and go on by others; told as JSON. Run by test_resume.

Nothing here waits for a moment on the clock: a process that is to be killed ends itself, as abruptly as SIGKILL does,
after a number of captures and a random time of its own on the processor. Children are forks of this process, so that
only it waits for imports.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from kornia_tidy.training.coded_datasets import Layout, render_scenes
from tests.forks import fork, wait
from tests.training.coded_datasets.samples import small_camera, small_scenes

COUNT, PATIENCE = 20, 60.0  # s that nobody waits for unless a process is left over
FORMS = {"folders": Layout(), "shards": Layout(shard_items=3)}
KILLED = {-signal.SIGKILL, -signal.SIGPROF}

Children = Sequence[Callable[[], object]]


def run(children: Children) -> tuple[set[int], bool]:
    """Run each in a process at the same time; return their exit codes, and whether their own processes ended too.

    All hold a pipe open that ends with the last of them.
    """
    last, held = os.pipe()
    processes = [fork(child) for child in children]
    os.close(held)
    codes = {wait(process) for process in processes}
    ended = bool(select.select([last], [], [], PATIENCE)[0])
    os.close(last)
    if not ended:
        for process in processes:
            os.killpg(process, signal.SIGKILL)
    return codes, ended


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def render(folder: Path, layout: Layout, rank: int = 0, world: int = 1, **options) -> None:
    render_scenes(small_camera(), small_scenes(COUNT), folder, layout, rank=rank, world=world, **options)


def render_killed(after: int, moment: float, *args, **options) -> None:
    """Render until so many captures have come, and for a time on the processor more."""
    steps = iter(range(1, COUNT + 1))

    def each(*_: int) -> None:
        if next(steps) == after:
            signal.setitimer(signal.ITIMER_PROF, moment) if moment else kill()

    render(*args, **options, each=each)


def go_on(folder: Path, layout: Layout, chance: random.Random, kills: int) -> list[int]:
    """Kill processes by turns, one, two or three, with one job or two; return how many parts were there after each."""
    there = []
    for turn in range(kills):
        world, jobs = 1 + turn % 3, 1 + turn % 2
        children = []
        for rank in range(world):
            moment = chance.uniform(1e-4, 0.01) if jobs == 1 else 0.0  # who has jobs does little but wait for them
            after = chance.randrange(4, 8) // world
            children.append(partial(render_killed, after, moment, folder, layout, rank, world, jobs=jobs))
        codes, ended = run(children)
        assert ended, "a process outlived the one that it renders for"
        assert codes <= {0, *KILLED}, codes
        assert turn or not codes & {0}, "the first turn was to be killed"
        there.append(sum((folder / part.name).exists() for part in layout.parts(COUNT)))
    assert run([partial(render, folder, layout, rank, 2) for rank in range(2)]) == ({0}, True)
    return there


def lose(folder: Path, layout: Layout) -> None:
    """Kill one of three processes after its first capture; the others take its work over."""
    lost = partial(render_killed, 1, 0.0, folder, layout, 0, 3)
    others = [partial(render, folder, layout, rank, 3, take_over=True) for rank in (1, 2)]
    assert run([lost, *others]) == ({0, -signal.SIGKILL}, True)


def bereave(folder: Path) -> dict[str, bool]:
    """Kill a process that has others render for it; return whether those ended, by the moment of the kill.

    Each capture is too large for a pipe to take two, so that they would wait for ever to hand the next one over.
    """

    def killed_after_forks(forks: int) -> None:
        count = iter(range(1, forks + 1))
        os.register_at_fork(after_in_parent=lambda: next(count) == forks and kill())
        render(folder / "forks", Layout(floats=True), jobs=2)

    def killed_at_a_capture() -> None:
        render(folder / "capture", Layout(floats=True), jobs=2, each=lambda *_: kill())

    moments = {
        "first fork": partial(killed_after_forks, 1),
        "second fork": partial(killed_after_forks, 2),
        "first capture": killed_at_a_capture,
    }
    told = {}
    for name, child in moments.items():
        codes, told[name] = run([child])
        assert codes == {-signal.SIGKILL}, f"{name}: {codes}"
    return told


def main(folder: Path, kills: int) -> None:
    torch.set_num_threads(1)
    chance, there = random.Random(time.time_ns()), {}
    for name, layout in FORMS.items():
        assert run([partial(render, folder / f"{name}-whole", layout)]) == ({0}, True)
        assert run([partial(render, folder / f"{name}-three", layout, rank, 3) for rank in range(3)]) == ({0}, True)
        lose(folder / f"{name}-lost", layout)
        there[name] = go_on(folder / f"{name}-killed", layout, chance, kills)
    print(json.dumps({"there": there, "ended": bereave(folder)}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
