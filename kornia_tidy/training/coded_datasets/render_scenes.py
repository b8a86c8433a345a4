"""Photographing of a data set of scenes to captures on disk, resumable and by any number of processes.

A capture depends only on camera, scene, seed and number. On the CPU its last digit depends on the number of threads:
see :mod:`kornia_tidy.render.repeatable`. Several processes share the work.
"""

from __future__ import annotations

import copy
import io
import itertools
import multiprocessing
import os
import tarfile
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.files import output_folder, remove_leftovers, replacing, write_bytes, write_folder
from kornia_tidy.render.repeatable import repeatable
from kornia_tidy.search_path import starting_workers
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.coded_datasets.conditions import claim, conditions
from kornia_tidy.training.coded_datasets.index import INDEX, encode_index
from kornia_tidy.training.coded_datasets.item_files import encode_item
from kornia_tidy.training.coded_datasets.layout import Layout, Part, item_key
from kornia_tidy.training.random_state import seeded

Files = dict[str, bytes]
Capture = tuple[str, Files]  # key and files of an item
Each = Callable[[int, int], None]

PLACES = (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS"))  # in the environment, by torchrun and by srun


class Rendered(NamedTuple):
    """Numbers of captures of one process."""

    made: int
    """Items photographed in this call."""
    found: int
    """Items that existed before."""


def place_among_processes() -> tuple[int, int]:
    """Return the number of this process among those that share the work, and their number.

    They are ``RANK`` and ``WORLD_SIZE`` in the environment, from torchrun, or those of srun; 0 and 1 without either.

    Raises:
        ValueError: if they are not whole numbers, the first below the second.
    """
    for rank, world in PLACES:
        if rank in os.environ:
            place = _whole(rank), _whole(world) if world in os.environ else 1
            if place[0] >= place[1]:
                raise ValueError(f"{rank} in the environment must be below {world}, {place[1]}, got {place[0]}")
            return place
    return 0, 1


def _whole(name: str) -> int:
    if not os.environ[name].isdecimal():
        raise ValueError(f"{name} in the environment must be a whole number, got {os.environ[name]!r}")
    return int(os.environ[name])


def render_scenes(
    optics: TiDyOptics,
    scenes: Dataset[Any],
    folder: str | os.PathLike[str],
    layout: Layout | None = None,
    *,
    seed: int = 0,
    jobs: int = 1,
    rank: int = 0,
    world: int = 1,
    take_over: bool = False,
    made_from: Mapping[str, Any] | None = None,
    each: Each | None = None,
) -> Rendered:
    """Photograph every scene of a data set and write the captures that do not exist yet.

    Args:
        optics: the camera.
        scenes: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere.
            Random scenes must use the global generators of torch, NumPy or Python.
        folder: made if missing. It gets ``render.json`` (all that determines the captures), the captures and, after the
            last one, ``index.csv``. :class:`CodedCaptures` reads it.
        layout: files of the captures. Default: a folder with all maps for each item.
        seed: of the sensor's noise. The capture of item i is that of ``optics.as_transform(seed)`` at index i.
        jobs: number of worker processes of this call.
        rank: number of this call among those that share the work, here or on other machines that see the folder.
        world: number of those calls. They need not run at the same time.
        take_over: once this call's share is complete, render captures that others have not written yet. The work of a
            process that was lost is then done by the others. Near the end several processes may render the same part,
            where they would otherwise wait: the first one that is complete stays.
        made_from: how camera and scenes were made, as plain values, for ``render.json``.
        each: called after each item with the number of finished items and of all items of this call.

    Returns:
        Numbers of items that this call photographed and found, those of others included.

    Raises:
        ValueError: if the folder holds other captures, or a scene cannot be used; written captures are kept.
        OSError: if a capture cannot be written, for example because the disk is full; written captures are kept.

    Convention:
        - An item or shard appears under its name when it is complete. After an interruption at any moment, the next
          call resumes, with any number of processes, and ends with the same bytes.
        - Bytes are equal on machines of one kind: other processors round the last digit of PSFs and FFTs differently.

    Example:
        >>> import tempfile
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> scenes = DeadLeaves(2, 64, 64, num_leaves=100)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(render_scenes(TiDyOptics(), scenes, folder))
        ...     print(sorted(path.name for path in Path(folder).iterdir()))
        ...     print(sorted(path.name for path in Path(folder, "000001").iterdir()))
        Rendered(made=2, found=0)
        ['000000', '000001', 'index.csv', 'render.json']
        ['coded.png', 'depth.npy', 'image.png', 'mask.png', 'scene.json']
    """
    layout = layout or Layout()
    if jobs < 1 or not 0 <= rank < world:
        raise ValueError(f"jobs must be 1 or more and rank one of {world} from 0, got {jobs} and {rank}")
    count = len(scenes)  # ty: ignore[invalid-argument-type]
    folder = output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    parts = layout.parts(count)
    own = parts[rank::world]
    missing = _missing(folder, own)
    total, made = _items_of(own), _items_of(missing)
    found = total - made
    with repeatable():
        claim(folder, conditions(optics, count, layout, seed, made_from or {}))
        items = _Captures(scenes, optics, layout, seed)
        counted = None if each is None else partial(_counted, each=each, found=found, total=total)
        _photograph(items, folder, missing, jobs, counted)
        if take_over:
            # The shares of other processes, from their ends: a process that still works on its own goes forward.
            others = [part for step in range(1, world) for part in parts[(rank + step) % world :: world][::-1]]
            for start in range(0, len(others), jobs):
                missing = _missing(folder, others[start : start + jobs])
                _photograph(items, folder, missing, jobs)
                made += _items_of(missing)
    if not _missing(folder, parts):
        _finish(folder, parts, layout)
    return Rendered(made, found)


def _missing(folder: Path, parts: Iterable[Part]) -> list[Part]:
    return [part for part in parts if not (folder / part.name).exists()]


def _items_of(parts: Iterable[Part]) -> int:
    return sum(len(part.items) for part in parts)


def shard_items_within(optics: TiDyOptics, scenes: Dataset[Any], layout: Layout, size: int, seed: int = 0) -> int:
    """Return the number of items in a shard of a given size, if all are as large as the first; at least one.

    Args:
        optics: the camera.
        scenes: the data set.
        layout: files of the captures; its ``shard_items`` is ignored.
        size: bytes of a shard.
        seed: of the sensor's noise.

    Raises:
        ValueError: if the first scene cannot be used.
    """
    with repeatable():
        capture = _Captures(scenes, optics, layout, seed)[0]
    if isinstance(capture, str):
        raise ValueError(capture)
    blocks = sum(1 + -(-len(data) // tarfile.BLOCKSIZE) for data in capture.values())  # a header before each file
    return max(1, size // (blocks * tarfile.BLOCKSIZE))


# ---------------------------------------------------------------------- photographing


class _Captures(Dataset):
    """Data set of encoded captures; a failed one is a sentence, as an exception in a worker shows its traceback."""

    def __init__(self, scenes: Any, optics: TiDyOptics, layout: Layout, seed: int) -> None:
        self.scenes, self.layout, self.seed = scenes, layout, seed
        self.optics = copy.deepcopy(optics)  # without cached PSFs, which more threads may have computed
        self.transform = self.optics.as_transform(seed)

    def __getitem__(self, index: int) -> Files | str:
        try:
            with seeded(keyed_seed(self.seed, "scene", index)):
                sample = self.transform({"name": item_key(index), **self.scenes[index], "index": index})
                sample.setdefault("mask", torch.ones_like(sample["depth"]))
                return encode_item(sample, self.optics.clamped_pixels, self.layout)
        except (KeyError, OSError, TypeError, ValueError) as error:
            reason = error.args[0] if isinstance(error, KeyError) else error  # as str() adds quotes
            return f"scene {index} of the data cannot be used: {reason}"


def _rendered(items: _Captures, indices: Sequence[int], jobs: int) -> Iterator[Capture]:
    """Yield captures in the order of indices; with several ``jobs``, worker processes compute them in advance."""
    loader = DataLoader(
        items,
        batch_size=None,
        sampler=indices,
        num_workers=0 if jobs == 1 else jobs,
        worker_init_fn=_end_with_parent,
        generator=torch.Generator().manual_seed(0),  # else it would draw from the global generator
    )
    with starting_workers():
        captures = iter(loader)
    for index, files in zip(indices, captures, strict=True):
        if isinstance(files, str):
            raise ValueError(files)
        yield item_key(index), files


def _end_with_parent(_: int) -> None:
    """End a worker with its parent: if that is killed, the worker would wait for ever to hand over a capture."""

    def watch() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _counted(captures: Iterator[Capture], *, each: Each, found: int, total: int) -> Iterator[Capture]:
    for done, capture in enumerate(captures, found + 1):
        each(done, total)
        yield capture


# ---------------------------------------------------------------------- writing


def _photograph(
    items: _Captures,
    folder: Path,
    parts: Sequence[Part],
    jobs: int,
    counted: Callable[[Iterator[Capture]], Iterator[Capture]] | None = None,
) -> None:
    """Render folders or shards and write each on completion."""
    captures = _rendered(items, [index for part in parts for index in part.items], jobs) if parts else iter(())
    captures = captures if counted is None else counted(captures)
    for part in parts:
        with _unless_there(folder / part.name), _told():
            _write(folder / part.name, itertools.islice(captures, len(part.items)), items.layout)


def _write(path: Path, captures: Iterable[Capture], layout: Layout) -> None:
    """Write a folder or a shard atomically."""
    if layout.shard_items is None:
        for _, files in captures:
            write_folder(path, files)
        return
    with replacing(path) as temporary:
        with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as shard:
            for key, files in captures:
                for name, data in files.items():
                    member = tarfile.TarInfo(f"{key}.{name}")  # without time and owner, so that bytes are reproducible
                    member.size = len(data)
                    shard.addfile(member, io.BytesIO(data))
        with temporary.open("rb") as written:
            os.fsync(written.fileno())  # else a power cut could leave an incomplete file under the name


@contextmanager
def _told() -> Generator[None]:
    """Add to an ``OSError`` that written captures are kept."""
    try:
        yield
    except (FileExistsError, FileNotFoundError):
        raise
    except OSError as error:
        raise OSError(
            f"{error}; files that were written before are intact, and the same call goes on from there"
        ) from error


@contextmanager
def _unless_there(path: Path) -> Generator[None]:
    """Ignore a failure if another process has meanwhile written the same file or folder."""
    try:
        yield
    except (FileExistsError, FileNotFoundError):
        if not path.exists():
            raise


def _finish(folder: Path, parts: Sequence[Part], layout: Layout) -> None:
    """Write the index and remove temporary files, in the process that finds all parts complete."""
    index = folder / INDEX
    if not index.exists():
        with _unless_there(index), _told():
            write_bytes(index, encode_index(folder, parts, layout))
    remove_leftovers(folder)
