"""Thousands of combinations of TIFF properties: `python -m tests.data.tiff_walk --count 3000 --seed 0`.

Each file is made by the writer of the tests and read as a picture and as depth. It must be read as it was written, or
refused in a sentence that names a property which is documented as not read. Counts are printed by property.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from kornia_tidy.data import read_depth, read_image
from tests.data.tiff_writer import Page, encoded, tiff

SIZE = (19, 23)
NODATA = 42113


@dataclass(frozen=True)
class Kind:
    """What the samples of a pixel mean."""

    photometric: int | None
    samples: int
    extra: tuple[int, ...] | None = None
    refusal: str = ""
    """Of pictures and depth."""
    colours: int = 1
    """Samples that are read."""


KINDS = {
    "grey": Kind(1, 1), "white is zero": Kind(0, 1), "RGB": Kind(2, 3, colours=3), "grey, alpha": Kind(1, 2, (2,)),
    "grey, opaque associated alpha": Kind(1, 2, (1,)), "RGBA": Kind(2, 4, (2,), colours=3),
    "RGB, opaque associated alpha": Kind(2, 4, (1,), colours=3), "RGB, unspecified": Kind(2, 4, (0,), colours=3),
    "RGB, fourth without a word": Kind(2, 4, None, colours=3), "palette": Kind(3, 1),
    "palette, alpha": Kind(3, 2, (2,)),
    "three grey (GDAL)": Kind(1, 3, (0, 0), colours=3), "three grey without a word": Kind(1, 3, None, colours=3),
    "three grey, alpha (GDAL)": Kind(1, 4, (0, 0, 2), colours=3), "white is zero, alpha": Kind(0, 2, (2,)),
    "none, 1 sample": Kind(None, 1), "none, 3 samples": Kind(None, 3, colours=3),
}  # fmt: skip
ODD_KINDS = {
    "grey, translucent associated alpha": Kind(1, 2, (1,), "ExtraSamples 1"),
    "RGB, translucent associated alpha": Kind(2, 4, (1,), "ExtraSamples 1"),
    "grey, unspecified": Kind(1, 2, (0,), "ExtraSamples 0"), "grey, second without a word": Kind(1, 2, None, "missing"),
    "grey, alpha, unspecified": Kind(1, 3, (2, 0), "ExtraSamples 2, 0"), "RGB, two": Kind(2, 5, (2, 0), "5 samples"),
    "grey, six": Kind(1, 7, (0,) * 6, "7 samples"), "palette, unspecified": Kind(3, 2, (0,), "ExtraSamples 0"),
    **{f"photometric {value}": Kind(value, samples, None, f"interpretation {value}|raw develop|transparency mask")
       for value, samples in ((4, 1), (5, 4), (6, 3), (8, 3), (9, 3), (10, 3), (32803, 1), (34892, 3), (32844, 1),
                              (32845, 3), (51177, 1), (52527, 1), (999, 1))},
}  # fmt: skip
NUMBERS = [*((1, bits) for bits in (1, 2, 4, 8, 8, 8, 10, 12, 14, 16, 16, 16, 32)), (2, 16), (2, 32), (3, 16), (3, 32),
           (3, 32), (3, 64)]  # fmt: skip
RARE_NUMBERS = [*((1, bits) for bits in (3, 5, 6, 7, 9, 11, 13, 15, 17, 20, 23, 25, 31, 64)), (2, 8), (2, 64)]
ODD_NUMBERS = [(1, 24), (1, 33), (1, 40), (1, 63), (2, 4), (2, 12), (2, 24), (3, 8), (3, 24), (4, 8), (4, 16), (5, 32),
               (6, 64), (7, 8)]  # fmt: skip
COMPRESSIONS = (1, 1, 5, 5, 8, 8, 32946, 32773, 34925, 50000)
ODD_COMPRESSIONS = (6, 9, 10, 99, 32766, 32771, 32809, 32909, 34661, 34676, 34677, 34712, 34887, 34892, 34926, 50001,
                    50002)  # fmt: skip
PREDICTED = (5, 8, 32946, 34925, 50000)
LAYOUTS = {
    "one strip": {}, "strips": {"rows_per_strip": 4}, "single rows": {"rows_per_strip": 1},
    "endless strip": {"rows_per_strip": 2**32 - 1}, "filled strips": {"rows_per_strip": 8, "filled": True},
    "tiles": {"tile": (16, 16)}, "wide tiles": {"tile": (16, 64)}, "a large tile": {"tile": (64, 32)},
}  # fmt: skip
PAGES = ("one", "one", "one", "page of a document", "preview behind", "preview first", "picture below", "mask behind")
ODD_PAGES = {"two": "2 pictures", "preview only": "NewSubfileType 1", "preview only, old": "preview"}
MISSING = ("none", "none", "none", "value", "value as float", "outside", "nan", "left out")
ODD_MISSING = {"no number": "GDAL_NODATA is 'x y'", "left out without a value": "is left out of it"}


@dataclass(frozen=True)
class Case:
    """One combination."""

    kind: str = "grey"
    numbers: tuple[int, int] = (1, 16)
    """SampleFormat and bits."""
    compression: int = 1
    predictor: int = 1
    layout: str = "one strip"
    separate: bool = False
    order: str = "<"
    big: bool = False
    fill_order: int = 1
    orientation: int | None = None
    pages: str = "one"
    missing: str = "none"

    @property
    def meaning(self) -> Kind:
        """Of the samples."""
        return (KINDS | ODD_KINDS)[self.kind]

    def refusals(self, depth: bool) -> list[str]:
        """Return what a sentence may say that refuses the file; empty if it must be read."""
        kind, (form, bits) = self.meaning, self.numbers
        palette = kind.photometric == 3
        predictor = self.predictor != 1 and (
            self.compression not in PREDICTED
            or self.predictor not in {2, 3}
            or bits not in {8, 16, 32, 64}
            or (self.predictor == 3 and form != 3)
        )
        shades = form == 1 and bits <= 16
        refused = {
            kind.refusal: bool(kind.refusal),
            f"{bits}-bit .*SampleFormat {form}": self.numbers in ODD_NUMBERS,
            f"compression is {self.compression} ": self.compression in ODD_COMPRESSIONS,
            f"predictor is {self.predictor} ": predictor,
            "FillOrder is": self.fill_order not in {1, 2},
            "indices of a palette": palette and not shades,
            "palette has": palette and form == 1 and bits > 16,
            ODD_PAGES.get(self.pages, ""): self.pages in ODD_PAGES,
            ODD_MISSING.get(self.missing, ""): self.missing in ODD_MISSING,
            "one channel": depth and kind.colours == 3,
            "no depth": depth and (kind.photometric == 0 or palette),
            "values must be": not depth and not (shades or form == 3 or palette),
            r"floats must lie in \[0, 1\]": not depth and form == 3 and self.missing == "nan",
        }
        return [sentence for sentence, applies in refused.items() if applies]


def ordinary(generator: np.random.Generator) -> Case:
    """Return a random combination of properties that are read."""

    def pick(values):
        return values[int(generator.integers(len(values)))]

    numbers = pick(RARE_NUMBERS if generator.random() < 0.2 else NUMBERS)
    compression = pick(COMPRESSIONS)
    predictors = [1]
    if compression in PREDICTED and numbers[1] in {8, 16, 32, 64}:
        predictors += [2, 3] if numbers[0] == 3 else [2]
    kinds = [name for name, kind in KINDS.items() if kind.photometric != 3 or (numbers[0] == 1 and numbers[1] <= 16)]
    case = Case(
        pick(["grey", "RGB", *kinds]), numbers, compression, pick(predictors), pick([*LAYOUTS]), bool(pick((0, 1))),
        pick("<>"), bool(pick((0, 0, 1))), pick((1, 1, 1, 2)), pick((None, None, *range(10))), pick(PAGES),
        pick(MISSING),
    )  # fmt: skip
    return settled(case)


def settled(case: Case) -> Case:
    """Return a combination without what cannot be with each other."""
    form, kind = case.numbers[0], case.meaning
    if (case.missing == "nan" and form != 3) or (
        case.missing != "none" and (kind.samples > 1 or kind.photometric == 3)
    ):
        case = replace(case, missing="none")
    if "left out" in case.missing and case.layout not in {"strips", "tiles", "single rows"}:
        case = replace(case, layout="strips")
    return replace(case, separate=case.separate and kind.samples > 1)


def cases(count: int, seed: int) -> Iterator[Case]:
    """Yield combinations: each property by itself first, then random ones, one in three with an odd property."""
    generator = np.random.default_rng(seed)
    odd = [
        *({"kind": kind} for kind in ODD_KINDS), *({"numbers": numbers} for numbers in ODD_NUMBERS),
        *({"compression": compression} for compression in ODD_COMPRESSIONS),
        *({"predictor": value, "compression": compression} for value in (2, 3, 34892) for compression in (1, 8)),
        {"fill_order": 0}, {"fill_order": 3}, *({"pages": pages} for pages in ODD_PAGES),
        *({"missing": missing} for missing in ODD_MISSING),
    ]  # fmt: skip
    alone = [
        *({"kind": kind} for kind in KINDS), *({"numbers": numbers} for numbers in {*NUMBERS, *RARE_NUMBERS}),
        *({"layout": layout, "separate": separate, "kind": "RGB"} for layout in LAYOUTS for separate in (False, True)),
        *({"orientation": value} for value in range(10)), *({"pages": pages} for pages in {*PAGES}),
        *({"missing": missing} for missing in {*MISSING}),
    ]  # fmt: skip
    single = [Case(), *(settled(replace(Case(), **change)) for change in [*alone, *odd])]
    generator.shuffle(single)
    yield from single[: count // 2]
    for number in range(count - min(len(single), count // 2)):
        case = ordinary(generator)
        yield case if number % 3 else settled(replace(case, **odd[int(generator.integers(len(odd)))]))


def make(case: Case, generator: np.random.Generator) -> tuple[bytes, np.ndarray, np.ndarray, np.ndarray]:
    """Return a file, its numbers (H, W, C) as a picture in [0, 1] and as they are stored, and where they are known."""
    kind, (form, bits) = case.meaning, case.numbers
    shape = (*SIZE, kind.samples)
    if form == 3:
        stored, white = generator.integers(1, 1024, shape) / 1024, 1.0  # exact in 16 bits
    else:
        white = 2.0**bits - 1
        stored = generator.integers(1, 2 ** (min(bits, 63) - (form == 2)), shape, endpoint=bits == 1)
        stored = stored if bits > 1 else generator.integers(0, 2, shape)
    if kind.extra is not None and 1 in kind.extra:
        stored[..., -1] = 1 if form == 3 else np.uint64(2 ** (bits - (form == 2)) - 1).astype(np.int64)
        if kind.refusal:
            stored[3, 4, -1] = 0
    known = np.ones(SIZE, bool)
    if kind.samples == 2:  # transparency
        known = stored[..., -1] != 0
    page = Page(
        stored, bits, form, 1 if kind.photometric is None else kind.photometric, kind.extra, case.separate,
        case.compression, case.predictor, case.fill_order == 2, **LAYOUTS[case.layout],
    )  # fmt: skip
    fields = page.fields
    if kind.photometric is None:
        fields[262] = None
    if case.orientation is not None:
        fields[274] = 3, [case.orientation]
    if case.fill_order not in {1, 2}:
        fields[266] = 3, [case.fill_order]
    known &= _mark_missing(case, page)
    if case.missing == "left out":
        stored = np.where(known[..., None], page.values, page.values[0, 0, 0])
    picture = stored[..., : kind.colours] / white
    if kind.photometric == 0:
        picture = 1 - picture
    if kind.photometric == 3 and form == 1 and bits <= 16:
        colours = generator.integers(0, 65536, (2**bits, 3))
        colours = colours // 257 * 257 if generator.random() < 0.5 else colours
        fields[320] = 3, colours.T.ravel().tolist()
        picture = colours[stored[..., 0]] / 65535
    return tiff(*_pages(case, page, known), order=case.order, big=case.big), picture, page.values[..., 0], known


def _mark_missing(case: Case, page: Page) -> np.ndarray:
    """Mark pixels as missing; return where they are not."""
    stored, known = page.values, np.ones(SIZE, bool)
    if case.missing in {"value", "value as float", "left out"}:
        value = stored[0, 0, 0]
        text = f"{float(value)!r}" if case.missing == "value as float" and case.numbers[1] <= 32 else f"{value} "
        page.fields[NODATA] = 2, text.encode() + b"\0"
        known = stored[..., 0] != value
    elif case.missing == "outside":
        page.fields[NODATA] = 2, b"-9999\0"
    elif case.missing == "nan":
        stored[2, 3] = np.nan
        page.fields[NODATA] = 2, b"nan\0"
        known = ~np.isnan(stored[..., 0])
    elif case.missing == "no number":
        page.fields[NODATA] = 2, b"x y\0"
    if case.missing.startswith("left out"):
        page.segments = encoded(page, case.order)
        page.segments[1] = b""
        high, column = (16, slice(16, None)) if page.tile else (page.rows_per_strip, slice(None))
        known[slice(0, high) if page.tile else slice(high, 2 * high), column] = False
    return known


def _pages(case: Case, page: Page, known: np.ndarray) -> list[Page]:
    small = Page(np.full((4, 5, 1), 77), fields={254: (4, [1])})
    if case.pages == "mask behind":
        known[5:9, 3:20] = False
        mask = Page(known[..., None].astype(int), 1, photometric=4, rows_per_strip=5, fields={254: (4, [4])})
        return [page, mask]
    if case.pages == "page of a document":
        page.fields[254] = 4, [2]
    if case.pages == "preview only":
        page.fields[254] = 4, [1]
    if case.pages == "preview only, old":
        page.fields[255] = 3, [2]
    if case.pages == "picture below":
        small.below = [page]
    return {"preview behind": [page, small], "preview first": [small, page], "picture below": [small],
            "two": [page, page]}.get(case.pages, [page])  # fmt: skip


def read(case: Case, path: Path, generator: np.random.Generator) -> tuple[bool, list[str]]:
    """Read a combination as a picture and as depth; return whether one of them works, and what is wrong."""
    data, picture, stored, known = make(case, generator)
    path.write_bytes(data)
    known = known & ((stored > 0) | np.isnan(stored))
    accepted, wrong = False, []
    turned = case.orientation in range(2, 9)
    for depth in (False, True):
        may_refuse = case.refusals(depth) + ["no valid depth"] * (depth and not known.any())
        try:
            with warnings.catch_warnings(action="ignore" if turned else None):  # once for each folder
                found = read_depth(path) if depth else read_image(path)
            if depth:
                found, valid = (part[0].numpy() for part in found)
                right = np.array_equal(valid, known) and np.array_equal(found[known], stored[known].astype(np.float32))
            else:
                found = found.numpy().transpose(1, 2, 0)
                levels = 2.0 ** min(case.numbers[1], 16) - 1 if case.meaning.photometric != 3 else 255
                right = found.shape == picture.shape and np.abs(found - picture).max() < 0.5 / levels
            accepted = True
            fault = f"is read, in place of {may_refuse}" if may_refuse else "" if right else "is read wrong"
        except ValueError as error:
            said = str(error).removeprefix(f"cannot read {path}: ")
            named = any(re.search(sentence, said) for sentence in may_refuse)
            blamed = "damaged" in said and "FillOrder" not in said
            fault = "" if named and not blamed else f"is refused, allowed are {may_refuse}: {said}"
        if fault:
            wrong.append(f"{'depth' if depth else 'picture'} {fault}: {case}")
    return accepted, wrong


def main() -> int:
    """Run, print the counts, and return 0 if all combinations behave."""
    parser = argparse.ArgumentParser(prog="python -m tests.data.tiff_walk", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3000, help="combinations (default: 3000)")
    parser.add_argument("--seed", type=int, default=0, help="(default: 0)")
    args = parser.parse_args()
    begin, counts, total, faults = time.perf_counter(), Counter(), Counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(tqdm(cases(args.count, args.seed), total=args.count)):
            accepted, wrong = read(case, Path(folder) / "a.tif", np.random.default_rng([args.seed, number]))
            faults += len(wrong)
            for sentence in wrong:
                tqdm.write(sentence)
            for name, value in vars(case).items():
                counts[name, str(value), "read" if accepted else "refused"] += 1
            total["read" if accepted else "refused"] += 1
    for name, value in dict.fromkeys((name, value) for name, value, _ in sorted(counts)):
        numbers = [f"{counts[name, value, result]:>6} {result}" for result in ("read", "refused")]
        print(f"{name:<12} {value:<36} {' '.join(numbers)}")
    print(
        f"{args.count} combinations: {total['read']} read as picture or depth or both, {total['refused']} refused, "
        f"{faults} faults, {time.perf_counter() - begin:.0f} s"
    )
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
