"""From a data set of scenes to coded captures on disk: stopped anywhere, it goes on; shared by any number of processes.

What an item becomes follows from camera, scene, seed and number alone. On the CPU the last digit of a capture depends
on the number of threads, so every process renders with one, and many processes make use of a machine.
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
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.coded_datasets.conditions import claim, conditions
from kornia_tidy.coded_datasets.index import INDEX, encode_index
from kornia_tidy.coded_datasets.item_files import encode_item
from kornia_tidy.coded_datasets.layout import Layout, Part, item_key
from kornia_tidy.files import remove_leftovers, replacing, write_bytes, write_folder
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.random_state import seeded

Files = dict[str, bytes]
Capture = tuple[str, Files]  # key and files of an item
Each = Callable[[int, int], None]


class Rendered(NamedTuple):
    """What one process did of its share."""

    made: int
    """Items rendered now."""
    found: int
    """Items that were there already."""


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
    made_from: Mapping[str, Any] | None = None,
    each: Each | None = None,
) -> Rendered:
    """Photograph every scene of a data set and write the captures; what is there already is left as it is.

    Args:
        optics: the camera.
        scenes: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere. What
            it draws at random it draws from torch's, NumPy's or Python's global generators.
        folder: made if missing. It gets ``render.json`` (everything that made the captures), the captures, and when all
            of them are there ``index.csv``. Read it with :class:`CodedCaptures`.
        layout: which files. Default: a folder for each item, with everything in it.
        seed: of the sensor's noise. The capture of item i is that of ``optics.as_transform(seed)`` at index i.
        jobs: processes that render here.
        rank: number of this process among those that share the work, here or on other machines that see the folder.
        world: number of those. They need not run at the same time, nor know of each other.
        made_from: how camera and scenes were made, as plain values, for ``render.json``.
        each: is told after each item how many of this process's items are done, and how many it has.

    Returns:
        How many items this process has rendered, and found.

    Raises:
        ValueError: if the folder holds other captures, or a scene cannot be used; what is written stays.
        OSError: if a capture cannot be written, the disk being full for one; what is written stays.

    Convention:
        - An item, or a shard of items, appears under its name when it is whole. Killed at any moment, the next run goes
          on, with whatever number of processes, and ends with the same bytes.
        - The same bytes on machines of one kind: other processors round the last digit of PSFs and FFTs differently.

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
    layout, folder = layout or Layout(), Path(folder)
    if jobs < 1 or not 0 <= rank < world:
        raise ValueError(f"jobs must be 1 or more and rank one of {world} from 0, got {jobs} and {rank}")
    count = len(scenes)  # ty: ignore[invalid-argument-type]
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    folder.mkdir(parents=True, exist_ok=True)
    parts = layout.parts(count)
    own = parts[rank::world]
    missing = [part for part in own if not (folder / part.name).exists()]
    total = sum(len(part.items) for part in own)
    found = total - sum(len(part.items) for part in missing)
    with _one_thread():
        claim(folder, conditions(optics, count, layout, seed, made_from or {}))
        items = _Captures(scenes, optics, layout, seed)
        captures = _rendered(items, [index for part in missing for index in part.items], jobs)
        if each is not None:
            captures = _counted(captures, each, found, total)
        for part in missing:
            with _unless_there(folder / part.name), _told():
                _write(folder / part.name, itertools.islice(captures, len(part.items)), layout)
    if all((folder / part.name).exists() for part in parts):
        _finish(folder, parts, layout)
    return Rendered(total - found, found)


def shard_items_within(optics: TiDyOptics, scenes: Dataset[Any], layout: Layout, size: int, seed: int = 0) -> int:
    """Return how many items a shard of a size holds, if all are as large as the first; at least one.

    Args:
        optics: the camera.
        scenes: the data set.
        layout: which files; its own ``shard_items`` is not looked at.
        size: bytes of a shard.
        seed: of the sensor's noise.

    Raises:
        ValueError: if the first scene cannot be used.
    """
    with _one_thread():
        capture = _Captures(scenes, optics, layout, seed)[0]
    if isinstance(capture, str):
        raise ValueError(capture)
    blocks = sum(1 + -(-len(data) // tarfile.BLOCKSIZE) for data in capture.values())  # a header before each file
    return max(1, size // (blocks * tarfile.BLOCKSIZE))


# ---------------------------------------------------------------------- rendering


class _Captures(Dataset):
    """The files of each capture; or a sentence, since a worker's exception would come back as its whole traceback."""

    def __init__(self, scenes: Any, optics: TiDyOptics, layout: Layout, seed: int) -> None:
        self.scenes, self.layout, self.seed = scenes, layout, seed
        self.optics = copy.deepcopy(optics)  # without the PSFs it remembers, which more threads may have made
        self.transform = self.optics.as_transform(seed)

    def __getitem__(self, index: int) -> Files | str:
        try:
            with seeded(keyed_seed(self.seed, "scene", index)):
                sample = self.transform({"name": item_key(index), **self.scenes[index], "index": index})
                sample.setdefault("mask", torch.ones_like(sample["depth"]))
                return encode_item(sample, self.optics.clamped_pixels, self.layout)
        except (KeyError, OSError, TypeError, ValueError) as error:
            reason = error.args[0] if isinstance(error, KeyError) else error  # which would come in quotes
            return f"scene {index} of the data cannot be used: {reason}"


def _rendered(items: _Captures, indices: Sequence[int], jobs: int) -> Iterator[Capture]:
    """Render items in this order; with several ``jobs``, processes keep some ahead of the one that writes."""
    loader = DataLoader(
        items,
        batch_size=None,
        sampler=indices,
        num_workers=0 if jobs == 1 else jobs,
        worker_init_fn=_end_with_parent,
        generator=torch.Generator().manual_seed(0),  # or it would draw from the global one
    )
    for index, files in zip(indices, loader, strict=True):
        if isinstance(files, str):
            raise ValueError(files)
        yield item_key(index), files


def _end_with_parent(_: int) -> None:
    """End this process with the one that writes: if that is killed, it would wait for ever to hand over a capture."""

    def watch() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _counted(captures: Iterator[Capture], each: Each, found: int, total: int) -> Iterator[Capture]:
    for done, capture in enumerate(captures, found + 1):
        each(done, total)
        yield capture


@contextmanager
def _one_thread() -> Generator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# ---------------------------------------------------------------------- writing


def _write(path: Path, captures: Iterable[Capture], layout: Layout) -> None:
    """Write a folder or a shard, whole or not at all."""
    if layout.shard_items is None:
        for _, files in captures:
            write_folder(path, files)
        return
    with replacing(path) as temporary:
        with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as shard:
            for key, files in captures:
                for name, data in files.items():
                    member = tarfile.TarInfo(f"{key}.{name}")  # of 1970 and nobody: bytes do not tell who and when
                    member.size = len(data)
                    shard.addfile(member, io.BytesIO(data))
        with temporary.open("rb") as written:
            os.fsync(written.fileno())  # or a power cut could leave the name on data never stored


@contextmanager
def _told() -> Generator[None]:
    """Say what a failure to write leaves."""
    try:
        yield
    except (FileExistsError, FileNotFoundError):
        raise
    except OSError as error:
        raise OSError(f"{error}; what was written before is intact, and the same call goes on from there") from error


@contextmanager
def _unless_there(path: Path) -> Generator[None]:
    """Let a failure be where another process has meanwhile written the same, and perhaps tidied up."""
    try:
        yield
    except (FileExistsError, FileNotFoundError):
        if not path.exists():
            raise


def _finish(folder: Path, parts: Sequence[Part], layout: Layout) -> None:
    """Write the index, by whichever process sees the last part come; then nobody writes here any more."""
    index = folder / INDEX
    if not index.exists():
        with _unless_there(index), _told():
            write_bytes(index, encode_index(folder, parts, layout))
    remove_leftovers(folder)
