"""Damaged files through every reading function: `python -m tests.mutations.reading --count 100000 --seed 0`.

A reader may return, or raise ``OSError`` or ``ValueError`` with a sentence. Any other error, a signal, a read of more
than a few seconds or more memory than it is given is a fault. Forks of this process read hundreds of files a second; a
fork that dies has its number noted, and the next goes on behind it. ``--guided`` keeps each damaged file that reaches
lines of the package in an order that no file before reached, and damages it further.
"""

from __future__ import annotations

import argparse
import os
import resource
import select
import shutil
import struct
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import kornia_tidy
from tests.mutations import containers, damage
from tests.mutations.damage import BLIND, BY_KIND, Generator, pick
from tests.mutations.pristine import Case
from tests.mutations.readers import SHARES, make_readers

LONGEST = 1000  # characters of a sentence
MEMORY = 3 << 29  # bytes of address space beyond that of this process
SECONDS = 20.0  # for one file; raw files have a limit of their own, in a process of their own
BATCH = 500  # files a fork
RESULTS = ("accepted", "refused", "failed")
PACKAGE = str(Path(kornia_tidy.__file__).parent)
MOST_KEPT = 2000  # files a batch that are damaged further

BY_STRUCTURE = BY_KIND | {
    "text": (containers.text_word, containers.text_word, containers.text_line),
    "hdf5": (containers.hdf5_structure,),
    "tar": (containers.tar_header,),
    "npz": (containers.npz_member,),
    "exr": (containers.exr_attribute,),
}


def main() -> int:
    """Run, and return 0 if all readers behaved."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations.reading", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000, help="files (default: 100000)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    parser.add_argument("--kind", help="of this kind only")
    parser.add_argument(
        "--guided", action="store_true", help="damage files further that reach new lines of the package"
    )
    parser.add_argument("--keep", type=Path, default=Path("outputs/mutations"), help="where failures are kept")
    args = parser.parse_args()
    torch.set_num_threads(1)  # threads do not live on in a fork
    begin, counts, spent = time.perf_counter(), {}, {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "whole").mkdir()
        readers = make_readers(folder / "whole")
        if args.kind:
            readers = {args.kind: readers[args.kind]}
        numbers = shared_out(args.count, list(readers))
        bar = tqdm(total=sum(numbers.values()), unit="file")
        for kind, number in numbers.items():
            counts[kind], since = Counter(), time.perf_counter()
            for first in range(0, number, BATCH):
                chosen = range(first, min(number, first + BATCH))
                for index, result, said, data in read_all(readers[kind], args.seed, chosen, folder, args.guided):
                    counts[kind][result] += 1
                    bar.update()
                    if result == "failed":
                        tell(args.keep, kind, args.seed, index, said, data)
            spent[kind] = time.perf_counter() - since
        bar.close()
    _table(counts, spent)
    seconds, total = time.perf_counter() - begin, sum(numbers.values())
    print(f"{total} files in {seconds:.0f} s, {total / seconds:.0f} a second, seed {args.seed}")
    return int(any(count["failed"] for count in counts.values()))


def shared_out(count: int, kinds: list[str]) -> dict[str, int]:
    """Return the number of files of each kind, at least one."""
    whole = sum(SHARES.get(kind, 1) for kind in kinds)
    return {kind: max(1, round(count * SHARES.get(kind, 1) / whole)) for kind in kinds}


Read = tuple[int, str, str, bytes]
"""Number of a file, what came of it, what was said, and the bytes if it failed."""


def read_all(cases: list[Case], seed: int, chosen: range, folder: Path, guided: bool = False) -> Iterator[Read]:
    """Yield what comes of damaged files by their numbers; they are read in forks of this process."""
    while chosen:
        read, write = os.pipe()
        process = os.fork()
        if process == 0:
            os.close(read)
            _child(cases, seed, chosen, folder, write, guided)
        os.close(write)
        last = chosen.start - 1
        for last, result, said, data in _received(read):
            yield last, result, said, data
        os.close(read)
        os.kill(process, 9)
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        chosen = range(last + 1, chosen.stop)
        if chosen:
            _, how, data = damaged_case(cases, seed, chosen.start)
            yield chosen.start, "failed", f"{how}: takes more than {SECONDS:g} s, or a signal (status {code})", data
            chosen = range(chosen.start + 1, chosen.stop)


def damaged_case(cases: list[Case], seed: int, number: int) -> tuple[Case, str, bytes]:
    """Return the damaged file of a number, and how it was damaged."""
    generator = np.random.default_rng([seed, number, *cases[0].kind.encode()])
    case = cases[int(generator.integers(len(cases)))]
    return case, *damaged_further(case.source.read_bytes(), case.damage, generator)


def damaged_further(data: bytes, kind: str, generator: Generator) -> tuple[str, bytes]:
    """Return a description of a random damage and the damaged file, which may have been damaged before."""
    own = BY_STRUCTURE[kind]
    for _ in range(10):
        change = pick(generator, own) if own and generator.random() < 0.5 else pick(generator, BLIND)
        try:
            return change.__name__, change(data, generator)
        except Exception:
            continue  # a header that is damaged already has no structure
    return "emptied", damage.emptied(data or b"\0", generator)


def try_read(case: Case, data: bytes, folder: Path) -> tuple[str, str]:
    """Read a damaged file; return what came of it and what was said."""
    place = folder / "case"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    if case.companions is not None:
        for other in case.companions.iterdir():
            if other.name != case.source.name:
                os.symlink(other, place / other.name)
    path = place / case.source.name
    path.write_bytes(data)
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case.read(path)
        result, said = "accepted", ""
    except (OSError, ValueError) as error:
        result, said = "refused", str(error)
        if not said.strip() or len(said) > LONGEST:
            return "failed", f"a sentence of {len(said)} characters: {said[:200]}"
    except BaseException as error:
        return "failed", f"{type(error).__name__}: {error!s:.300}"
    if time.perf_counter() - begin > SECONDS / 2:
        return "failed", f"takes {time.perf_counter() - begin:.1f} s"
    return result, said


# ---------------------------------------------------------------------- in the fork


def _child(cases: list[Case], seed: int, chosen: range, folder: Path, write: int, guided: bool) -> None:
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 2)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        kept: list[tuple[Case, bytes]] = []
        reached: set[tuple[str, int, int]] = set()
        for number in chosen:
            case, how, data = damaged_case(cases, seed, number)
            if guided and kept and number % 2:
                generator = np.random.default_rng([seed, number])
                case, before = kept[int(generator.integers(len(kept)))]
                how, data = damaged_further(before, case.damage, generator)
            lines: set[tuple[str, int, int]] = set()
            if guided:
                sys.settrace(_tracer(lines))
            result, said = try_read(case, data, folder)
            sys.settrace(None)
            if guided and not lines <= reached and len(kept) < MOST_KEPT and len(data) < 1 << 20:
                reached |= lines
                kept.append((case, data))
            said = f"{case.source.name}, {how}: {said}" if result == "failed" else ""
            _send(write, (number, result, said, data if result == "failed" else b""))
    finally:
        os._exit(0)


def _tracer(lines: set[tuple[str, int, int]]) -> Any:
    """Return a trace function that notes pairs of lines of the package that follow each other."""

    def local(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal before
        if event == "line":
            lines.add((frame.f_code.co_filename, before, frame.f_lineno))
            before = frame.f_lineno
        return local

    def trace(frame: FrameType, _: str, __: Any) -> Any:
        return local if frame.f_code.co_filename.startswith(PACKAGE) else None

    before = 0
    return trace


def _send(write: int, read: Read) -> None:
    number, result, said, data = read
    text = said.encode("utf-8", "replace")[:2000]
    message = struct.pack("<QBII", number, RESULTS.index(result), len(text), len(data)) + text + data
    while message:
        message = message[os.write(write, message) :]


def _received(read: int) -> Iterator[Read]:
    """Yield what a fork sends, until it ends or is silent for too long."""
    buffer, head = b"", struct.calcsize("<QBII")
    while True:
        if not select.select([read], [], [], SECONDS)[0]:
            return
        part = os.read(read, 1 << 16)
        if not part:
            return
        buffer += part
        while len(buffer) >= head:
            number, result, text, data = struct.unpack_from("<QBII", buffer)
            if len(buffer) < head + text + data:
                break
            said = buffer[head : head + text].decode()
            yield number, RESULTS[result], said, buffer[head + text : head + text + data]
            buffer = buffer[head + text + data :]


def tell(keep: Path, kind: str, seed: int, number: int, said: str, data: bytes) -> None:
    """Print a fault and keep the file that shows it."""
    keep.mkdir(parents=True, exist_ok=True)
    (keep / f"{kind}-{seed}-{number}").write_bytes(data)
    tqdm.write(f"{keep}/{kind}-{seed}-{number}: {said}")


def _table(counts: dict[str, Counter[str]], spent: dict[str, float]) -> None:
    print(f"{'kind':<12}{'files':>8}{''.join(f'{name:>10}' for name in RESULTS)}{'seconds':>10}")
    for kind, count in [*counts.items(), ("all", sum(counts.values(), Counter()))]:
        results = "".join(f"{count[name]:>10}" for name in RESULTS)
        print(f"{kind:<12}{sum(count.values()):>8}{results}{spent.get(kind, sum(spent.values())):>10.1f}")


if __name__ == "__main__":
    sys.exit(main())
