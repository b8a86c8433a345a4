"""Damaged lenses, in every form that they come in: ``python -m tests.optics.lens.mutate --count 2000``.

Each must be accepted, with finite numbers, or be refused in one sentence by a ``ValueError`` or ``TypeError``.
"""

from __future__ import annotations

import argparse
import copy
import json
import random
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from kornia_tidy.optics import Lens
from tests.optics.lens.lenses import plano_convex, symmetric_pair
from tests.optics.lens.written_files import WRITERS, aspheric, doublet, named

SECONDS, LONGEST = 30.0, 400  # of processor time for a lens, and characters of a sentence
MEMORY = 6 << 30
HOSTILE: tuple[Any, ...] = (
    None, True, 0, -1, 1e-300, 1e300, -1e300, float("nan"), float("inf"), 1e-6, 1e6, 17, "", "air", "N-BK7",
    "\u00e9" * 999, [], [1.0], {}, {"4": 1e9}, {"x": 1}, b"x", 2**70,
)  # fmt: skip
WORDS = (
    "",
    "nan",
    "inf",
    "-1",
    "1e400",
    "0",
    "x",
    "1,5",
    ",",
    ",,",
    "\n",
    "Z999",
    "Z4",
    '"',
    "\x00",
    "field_mm",
    "-1e30",
)


PROGRAM_WORDS = (
    *WORDS, "INFINITY", "SURF", "STOP", "TYPE", "COORDBRK", "EVENASPH", "GLAS", "MIRROR", "___BLANK", "XDAT", "UNIT",
    "IN", "CURV", "DISZ", "PARM", "S", "SO", "SI", "STO", "ASP", "K", "A", "CIR", "REFL", "500.500", "PRV", "RDM",
    "DIM", "{", "}", "[", "null", "true", "1e-300", "1e300", "9" * 400,
)  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where a nested value has values."""
    if path:
        yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        yield from places(entry, (*path, key))


def mutated(value: Any, draw: random.Random) -> Any:
    """The value with one to three entries replaced, removed, scaled, doubled or moved."""
    value = copy.deepcopy(value)
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        if not (known := list(places(value))):
            break
        path = draw.choice(known)
        owner = value
        for key in path[:-1]:
            owner = owner[key]
        key, kind = path[-1], draw.choice(("replace", "replace", "scale", "remove", "double", "name"))
        if kind == "scale" and isinstance(owner[key], float):
            owner[key] *= draw.choice((-1, 1e-3, 1e3, 0.5, 1.01, 30))
        elif kind == "remove":
            del owner[key]
        elif kind == "double" and isinstance(owner, list):
            owner.insert(key, copy.deepcopy(owner[key]))
        elif kind == "name" and isinstance(owner, dict):
            owner[draw.choice((str(key).upper(), f"{key} ", "radius", 7))] = owner.pop(key)
        else:
            owner[key] = copy.deepcopy(draw.choice(HOSTILE))
    return value


def damaged_text(text: str, draw: random.Random, words: tuple[str, ...], mark: str | None) -> str:
    """The text with a word or a line replaced, removed or doubled; words lie between marks."""
    lines = text.splitlines()
    row = draw.randrange(len(lines))
    kind = draw.choice(("word", "word", "word", "remove", "double", "cut"))
    if kind == "word":
        parts = lines[row].split(mark) or [""]
        parts[draw.randrange(len(parts))] = draw.choice(words)
        lines[row] = (mark or " ").join(["  "] * (mark is None and lines[row][:1] == " ") + parts)
    elif kind == "cut":
        return text[: draw.randrange(len(text))]
    else:
        lines[row : row + 1] = [] if kind == "remove" else [lines[row]] * 2
    return "\n".join(lines) + "\n"


def damaged_bytes(data: bytes, draw: random.Random) -> bytes:
    """The bytes with some of them changed, or cut short."""
    changed = bytearray(data)
    if draw.random() < 0.2:
        return bytes(changed[: draw.randrange(len(changed))])
    begin = draw.choice((0, 0, draw.randrange(len(changed))))  # the header is where most can go wrong
    for _ in range(draw.randint(1, 6)):
        changed[min(len(changed) - 1, begin + draw.randrange(900))] = draw.randrange(256)
    return bytes(changed)


def trial(seed: int, folder: Path) -> Callable[[], Lens]:
    """What makes the lens of a seed."""
    draw = random.Random(seed)
    kind = draw.choice(("prescription", "prescription", "numbers", "table", "file", "program", "program", "program"))
    if kind in {"prescription", "numbers"}:
        given: dict[str, Any] = {"f_number": 8.0, "focus_distance": 0.6, "field": 4e-3, "wavelengths": [530e-9]}
        prescription = draw.choice((plano_convex, symmetric_pair))()
        if kind == "prescription":
            prescription = mutated(json.loads(json.dumps(prescription)), draw)
        else:
            given = mutated(given, draw)
        return lambda: Lens.from_prescription(prescription, **given)
    if kind == "program":
        suffix = draw.choice(list(WRITERS))
        given = draw.choice((doublet, lambda: named("single-50mm")) if suffix == ".seq" else (doublet, aspheric))()
        path, text = folder / f"lens{suffix}", WRITERS[suffix](given)
        if suffix.endswith(".json") and draw.random() < 0.8:
            text = json.dumps(mutated(json.loads(text), draw), default=repr)
        else:
            text = damaged_text(text, draw, PROGRAM_WORDS, None)
        data = text.encode(draw.choice(("utf-8", "utf-8", "utf-16")))
        path.write_bytes(damaged_bytes(data, draw) if draw.random() < 0.2 else data)
        return lambda: Lens.from_prescription(path, 8.0, 0.6, wavelengths=[530e-9], field=4e-3)
    path = folder / f"lens.{'csv' if kind == 'table' else 'safetensors'}"
    if kind == "table":
        text = "field_mm,wavelength_nm,Z4,Z7\n0,530,0.1,0.0\n2.5,530,0.1,0.2\n5,530,0.1,0.4\n"
        path.write_text(damaged_text(text, draw, WORDS, ","))
        return lambda: Lens.from_zernike_table(path, 50e-3, 8.0, 0.6)
    Lens.from_seidel(50e-3, 8.0, 0.6, 5e-3, coma=1.0).save(path)
    path.write_bytes(damaged_bytes(path.read_bytes(), draw))
    return lambda: Lens.load(path)


def outcome(seed: int, folder: Path) -> tuple[str, str]:
    """How a damaged lens was taken: "accepted", "refused" or "failed", and what was said."""
    make, begin = trial(seed, folder), time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lens = make()
            tensors = list(lens.table.tensors().values())
        if not all(bool(torch.isfinite(part).all()) for part in tensors):
            return "failed", "the table is not finite"
    except (ValueError, TypeError) as error:
        if "\n" in str(error) or not 10 < len(str(error)) <= LONGEST:
            return "failed", f"no sentence: {error!r:.300}"
        if time.process_time() - begin > SECONDS:
            return "failed", f"{time.process_time() - begin:.0f} s"
        return "refused", str(error)
    except Exception as error:  # any other is a fault, to be told
        return "failed", f"{type(error).__name__}: {error!s:.300}"
    if time.process_time() - begin > SECONDS:
        return "failed", f"{time.process_time() - begin:.0f} s"
    return "accepted", ""


def main() -> int:
    """Run, and return 0 if every damaged lens was taken or refused in a sentence."""
    parser = argparse.ArgumentParser(prog="python -m tests.optics.lens.mutate", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="lenses (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, help="the first (default: 0)")
    args = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in tqdm(range(args.seed, args.seed + args.count)):
            result, said = outcome(seed, Path(folder))
            counts[result] += 1
            if result == "failed":
                tqdm.write(f"{seed}: {said}")
    print(dict(counts))
    return int(counts["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
