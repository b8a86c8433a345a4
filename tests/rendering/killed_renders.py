"""Render by several processes that are killed at random moments, and go on by others; told as JSON. Run by test_resume.

Children are forks of this process, so that only it waits for imports.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import torch

from kornia_tidy.rendering import Layout, render_scenes
from tests.rendering.samples import small_camera, small_scenes

COUNT = 30


def children(folder: Path, layout: Layout, world: int, jobs: int = 1) -> list[int]:
    return [child(folder, layout, rank, world, jobs) for rank in range(world)]


def child(folder: Path, layout: Layout, rank: int, world: int, jobs: int) -> int:
    process = os.fork()
    if process == 0:
        code = 1
        try:
            render_scenes(small_camera(), small_scenes(COUNT), folder, layout, jobs=jobs, rank=rank, world=world)
            code = 0
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(code)
    return process


def wait(processes: list[int]) -> set[int]:
    return {os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes}


def there(folder: Path, layout: Layout) -> int:
    """How many folders or shards are there."""
    return sum((folder / part.name).exists() for part in layout.parts(COUNT))


def main(folder: Path, kills: int) -> None:
    torch.set_num_threads(1)
    chance, told = random.Random(time.time_ns()), {}
    for name, layout in (("folders", Layout()), ("shards", Layout(shard_items=4))):
        whole, killed = folder / f"{name}-whole", folder / f"{name}-killed"
        assert wait(children(whole, layout, 1)) == {0}
        assert wait(children(folder / f"{name}-three", layout, 3)) == {0}  # at the same time
        told[name] = []
        for kill in range(kills):
            target = there(killed, layout) + chance.randrange(1, 4)
            processes = children(killed, layout, 1 + (kill + 1) % 3, 1 + kill % 2)
            deadline = time.monotonic() + 30
            while there(killed, layout) < min(target, len(layout.parts(COUNT))) and time.monotonic() < deadline:
                time.sleep(0.002)
            time.sleep(chance.uniform(0, 0.02))  # into a later capture, its files, the index, or tidying up
            for process in processes:
                os.kill(process, signal.SIGKILL)
            assert wait(processes) <= {0, -signal.SIGKILL}
            told[name].append(there(killed, layout))
        assert wait(children(killed, layout, 2)) == {0}
    print(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
