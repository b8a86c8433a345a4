"""DNGs of every kind, seeded, with the light and colours that were written: what a reader must find in them.

`python -m tests.raw.dng_kinds 0 3000` reads as many and prints how many were read right and which were refused.
"""

from __future__ import annotations

import itertools
import re
import sys
import warnings
import zlib
from collections import Counter
from dataclasses import dataclass

import imagecodecs
import numpy as np
import torch

from kornia_tidy.raw.capture import RawCapture
from kornia_tidy.raw.filter_array import tiled
from tests.raw.dng import BYTE, LONG, RATIONAL, SHORT, SRATIONAL, UNDEFINED, XTRANS, dng
from tests.raw.test_mutations import forked_decoding

CODES = "RGBCMYW"
QUAD, QUAD_WHITE = "RRGGRRGGGGBBGGBB", "WRWGRWGWWGWBGWBW"
CONTRADICTIONS = {
    "staggered": "its CFALayout is 2",
    "period": r"its filter array repeats after 5 x 5 pixels",
    "two colours": "its filter array has the colours",
    "separate JPEG": "cannot be decoded",
    "strips of JPEG": "strips compressed by JPEG",
    "not finite": "1 of its floating-point samples are not finite",
}


@dataclass
class Kind:
    """A DNG and what was written into it; light and letters cover its active area."""

    name: str
    data: bytes
    light: np.ndarray  # (C, H, W), of the stored samples, in the order of planes
    count: np.ndarray  # light of one count (for floating-point samples: of one part in 2^11)
    letters: np.ndarray | None  # (H, W)
    planes: str
    neutral: dict[str, float]
    opcodes: bool
    fault: str | None  # in the sentence of the refusal


def kind(seed):
    """Return the DNG of a seed; about one in ten is of a kind that must be refused."""
    draw = np.random.default_rng(seed)
    pick = lambda *choices: choices[draw.integers(len(choices))]
    order, fault = pick("<", ">"), None
    height, width = (int(n) for n in draw.integers(30, 60, 2))
    corner = pick((0, 0), tuple(int(n) for n in draw.integers(0, 7, 2)))
    top, left = corner
    bottom, right = (end - int(draw.integers(0, 3)) for end in (height, width))
    extra = {}

    # Colours
    array = pick("Bayer", "Bayer", "Bayer", "permuted", "four", "quad", "X-Trans", "3x3", "2x4", "one colour", "linear")
    planes, tile, samples = "RGB", None, 1
    if array == "Bayer":
        tile = np.array(list(pick("RGGB", "BGGR", "GRBG", "GBRG"))).reshape(2, 2)
    elif array == "permuted":
        planes = pick("RGB", "RYB", "CMY", "RWB")
        tile = draw.permutation(list(planes + pick(*planes))).reshape(2, 2)
    elif array == "four":
        planes = "".join(draw.permutation(list(pick("RGBW", "RGBC", "GMCY", "RGBY", "WCMY"))))
        tile = draw.permutation(list(planes)).reshape(2, 2)
    elif array == "quad":
        planes, letters = pick(("RGB", QUAD), ("RGBW", QUAD_WHITE))
        tile = np.roll(np.array(list(letters)).reshape(4, 4), draw.integers(0, 4, 2), (0, 1))
    elif array == "X-Trans":
        tile = np.roll(np.array(list(XTRANS)).reshape(6, 6), draw.integers(0, 6, 2), (0, 1))
    elif array == "3x3":
        tile = draw.permutation(list("RGBGGGRBG")).reshape(3, 3)
    elif array == "2x4":
        tile = draw.permutation(list("RGBGGRGB")).reshape(pick((2, 4), (4, 2)))
    elif array == "one colour":
        tile = np.full(pick((1, 1), (2, 2)), pick("G", "R"))
    else:
        samples = pick(1, 3, 3, 4)
        planes = {1: "", 3: pick("RGB", "BGR"), 4: pick("RGBW", "GMCY")}[samples]
    named = planes or "RGB"
    if array in {"Bayer", "X-Trans", "permuted"} and draw.random() < 0.3:
        named = planes = "".join(draw.permutation(list(planes)))
    if named != "RGB" or draw.random() < 0.5:
        extra[50710] = (BYTE, [CODES.index(letter) for letter in named])
    if tile is not None:
        extra[33421] = (SHORT, list(tile.shape))
        extra[33422] = (BYTE, [CODES.index(letter) for letter in tile.ravel()])
        extra[50711] = (SHORT, [1])
    neutral = {letter: round(float(draw.uniform(0.4, 1)), 2) for letter in named}

    # Samples
    floating = draw.random() < 0.25
    bits = int(pick(16, 24, 32) if floating else pick(8, 10, 12, 14, 16, 16, 16))
    compression = int(pick(1, 1, 8) if floating or bits in {8, 16} else pick(1, 7 if samples == 1 else 1))
    separate = samples > 1 and draw.random() < 0.5
    dead = {"staggered": tile is not None, "period": tile is not None, "two colours": tile is not None}
    dead |= {"separate JPEG": separate, "strips of JPEG": not separate and samples == 1, "not finite": floating}
    if draw.random() < 0.1:
        fault = pick(*[name for name, possible in dead.items() if possible] or [None])
    if fault == "staggered":
        extra[50711] = (SHORT, [2])
    elif fault == "period":
        extra[33421], extra[33422] = (SHORT, [5, 5]), (BYTE, ([0, 1, 2] * 9)[:25])
        extra[50710] = (BYTE, [0, 1, 2])
    elif fault == "two colours":
        extra[33421], extra[33422] = (SHORT, [2, 2]), (BYTE, [0, 1, 1, 0])
        extra[50710] = (BYTE, [0, 1, 2])
    elif fault in {"separate JPEG", "strips of JPEG"}:
        compression, floating, bits = 7, False, 16

    # Levels
    white_all = 1 if floating and draw.random() < 0.5 else int(0.9 * (2 ** min(bits, 16) - 1))
    unit = 1 if not floating else white_all / 1024
    repeat = pick((1, 1), (1, 1), (2, 2), (1, 2), (2, 1), (4, 4), (3, 3), (6, 6), (5, 2))
    number = int(np.prod(repeat)) * samples
    number = 1 if repeat == (1, 1) and draw.random() < 0.4 else number
    step = pick(1, 0.25)
    black = np.round(draw.uniform(0, 0.15 * white_all / unit, number) / step) * step * unit
    if draw.random() < 0.15:
        black *= 0
    whites = [white_all] * samples
    if samples > 1 and draw.random() < 0.3:
        whites = [int(w) for w in draw.integers(white_all * 3 // 4, white_all, samples)] if white_all > 1 else whites
    extra[50713], extra[50714] = (SHORT, list(repeat)), (RATIONAL, black.tolist())
    extra[50717] = (LONG, whites)
    area = (bottom - top, right - left)
    levels = np.resize(black, (*repeat, samples)) if number > 1 else np.full((1, 1, samples), black[0])
    y, x = np.mgrid[: area[0], : area[1]]
    level = levels[y % repeat[0], x % repeat[1]] if number > 1 else np.full((*area, samples), black[0])
    for axis, tag in ((1, 50715), (0, 50716)):
        if draw.random() < 0.12:
            values = np.round(draw.uniform(-3, 3, area[axis]) / step) * step * unit
            extra[tag] = (SRATIONAL, values.tolist())
            level = level + (values[None, :, None] if axis else values[:, None, None])

    # The stored picture, whose borders hold anything
    span = np.array(whites) - level
    most = 40 if floating and bits > 16 else 1.05
    light = draw.uniform(-0.02, most, (*area, samples))
    stored = draw.uniform(0, white_all, (height, width, samples))
    stored[top:bottom, left:right] = level + light * span
    table = None
    if floating:
        stored = _floats(stored, bits)
    else:
        stored = stored.round().clip(0, 2**bits - 1).astype(np.uint16)
        if bits < 16 and draw.random() < 0.3:
            table = np.sort(draw.integers(0, white_all, 2**bits)) if bits < 12 else np.arange(2**bits) // 2 * 2
            extra[50712] = (SHORT, table.tolist())
    if fault == "not finite":
        stored[top + 3, left + 5, 0] = pick(np.nan, np.inf)
    seen = (table[stored] if table is not None else stored.astype(float))[top:bottom, left:right]
    if corner != (0, 0) or (bottom, right) != (height, width) or draw.random() < 0.3:
        extra[50829] = (LONG, [top, left, bottom, right])
        extra[50719] = (LONG, [1, 3])  # DefaultCropOrigin, which changes nothing
        if left:
            extra[50830] = (LONG, [0, 0, height, left])  # MaskedAreas, likewise, as the black level is given
    if draw.random() < 0.2:
        extra[51009] = (UNDEFINED, gain_map())
    how = _stored(stored, bits, floating, compression, separate, order, draw, extra, fault)
    extra |= {
        258: (SHORT, [bits] * samples),
        259: (SHORT, [compression]),
        284: (SHORT, [2 if separate else 1]),
        339: (SHORT, [3 if floating else 1] * samples),
    }
    counts = stored[..., 0] if samples == 1 else stored
    data = dng(
        counts, None if tile is None else "", order=order, extra=extra, neutral=[neutral[p] for p in named],
        matrix=np.eye(len(named), 3).ravel().tolist(), orientation=int(draw.integers(1, 9)), **how,
    )  # fmt: skip
    at = None
    if tile is not None and array != "one colour":
        at = tile[y % tile.shape[0], x % tile.shape[1]]
    places = ("strips", "tiles")[how.get("tiles", False)]
    name = f"{array}, {samples} samples of {bits} {'float' if floating else 'integer'} bits, {order}, "
    name += f"compression {compression}, {places}{' in planes' if separate else ''}, corner {corner}, black {repeat}"
    name += ", delta" * len({50715, 50716} & set(extra)) + ", table" * (table is not None) + f" {fault or ''}"
    light = ((seen - level) / span).transpose(2, 0, 1)
    unit = 2.0**-11 if floating else 1
    count = (np.maximum(1e-4 * white_all, abs(seen)) * unit if floating else 1) / span
    count = np.broadcast_to(count, span.shape).transpose(2, 0, 1)
    return Kind(name, data, light, count, at, "" if array == "one colour" else planes, neutral, 51009 in extra, fault)


def gain_map():
    """Return the bytes of a list of one optional gain map of 2 x 2 points."""
    text = b"".join(n.to_bytes(4, "big") for n in (0, 0, 10, 10, 0, 1, 1, 1, 2, 2))
    text += np.array([1, 1, 0, 0], ">f8").tobytes() + (1).to_bytes(4, "big") + np.array([1, 1.5, 2, 1], ">f4").tobytes()
    return b"".join(n.to_bytes(4, "big") for n in (1, 9, 0x01030000, 1, len(text))) + text


def _floats(values, bits):
    """Return float32 values that the bits can hold exactly."""
    if bits == 16:
        return values.astype(np.float16).astype(np.float32)
    values = values.astype(np.float32)
    return (values.view(np.uint32) & 0xFFFFFF80).view(np.float32) if bits == 24 else values


def _stored(stored, bits, floating, compression, separate, order, draw, extra, fault):
    """Return the arguments of `dng` that store a picture in strips or tiles, in any order, with gaps."""
    height, width, samples = stored.shape
    tiled = draw.random() < 0.4 if fault != "strips of JPEG" else False
    if tiled:
        rows, columns = (int(16 * n) for n in draw.integers(1, 5, 2))
        columns = min(columns, 16) if compression == 7 else columns  # LibRaw cannot decode wider ones than the picture
        extra[322], extra[323] = (LONG, [columns]), (LONG, [rows])
        extra[278] = None
    else:
        rows, columns = int(draw.integers(5, height + 9)), width
        if compression == 7:
            rows = height // 3 if fault == "strips of JPEG" else height
        extra[278] = (LONG, [rows])
    predictor = 1
    if compression == 8:
        choices = [1, 3, 34894, 34895] if floating else [1, 2, 34892, 34893]
        predictor = int(draw.choice(choices[: 2 if columns % 4 else 4]))
        extra[317] = (SHORT, [predictor])
    planes = stored.transpose(2, 0, 1)[..., None] if separate else stored[None]
    blocks = []
    for plane, y, x in itertools.product(planes, range(0, height, rows), range(0, width, columns)):
        block = plane[y : y + rows, x : x + columns]
        if tiled:
            block = np.pad(block, ((0, rows - block.shape[0]), (0, columns - block.shape[1]), (0, 0)), "edge")
        blocks.append(_encoded(block, bits, floating, compression, predictor, order))
    gaps = [int(draw.integers(0, 40)) for _ in blocks] if draw.random() < 0.4 else [0] * len(blocks)
    return {"blocks": blocks, "gaps": gaps, "tiles": tiled}


def _encoded(block, bits, floating, compression, predictor, order):
    rows, columns, samples = block.shape
    if compression == 7:
        return imagecodecs.ljpeg_encode(np.ascontiguousarray(block[..., 0]), bitspersample=bits)
    line = block.reshape(rows, columns * samples)
    if floating:
        parts = _float_bytes(line, bits)  # (rows, samples, bytes), the highest first
        if predictor == 1:
            text = (parts if order == ">" else parts[..., ::-1]).tobytes()
        else:
            step = samples * {3: 1, 34894: 2, 34895: 4}[predictor]
            text = _differences(np.ascontiguousarray(parts.transpose(0, 2, 1)).reshape(rows, -1), step).tobytes()
    elif bits in {8, 16}:
        values = line.astype(f"u{bits // 8}")
        if predictor != 1:
            values = _differences(values, samples * {2: 1, 34892: 2, 34893: 4}[predictor])
        text = values.astype(f"{order}u{bits // 8}").tobytes()
    else:
        high_first = np.unpackbits(line.astype(">u2").view(np.uint8).reshape(rows, -1, 2), axis=-1)[..., 16 - bits :]
        text = np.packbits(high_first.reshape(rows, -1), axis=1).tobytes()
    return zlib.compress(text) if compression == 8 else text


def _float_bytes(line, bits):
    if bits == 24:
        words = line.astype(np.float32).view(np.uint32)
        exponent = (words >> 23 & 255).astype(np.int64)
        small = np.where(words & 0x7FFFFFFF, exponent - 64, 0)
        small = np.where(exponent == 255, 127, small).astype(np.uint32)
        words = words >> 31 << 23 | small << 16 | (words & 0x7FFFFF) >> 7
        return words.astype(">u4").view(np.uint8).reshape(*line.shape, 4)[..., 1:]
    return line.astype(f">f{bits // 8}").view(np.uint8).reshape(*line.shape, bits // 8)


def _differences(values, step):
    result = values.copy()
    result[:, step:] -= values[:, :-step]
    return result


def outcome(one):
    """Return what became of a DNG, "read right" or the sentence of its refusal, and the largest error in counts.

    Raises:
        AssertionError: if it was read wrong, or refused though it is of a kind that is read, or the reverse.
    """
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            raw = RawCapture.open(one.data)
    except ValueError as error:
        sentence = str(error)
        assert re.fullmatch(r"cannot read the raw file of \d+ bytes: [^\n]{10,300}", sentence), (one.name, sentence)
        assert one.fault and re.search(CONTRADICTIONS[one.fault], sentence), (one.name, sentence)
        return sentence.split(": ", 1)[1], 0.0
    assert not one.fault, f"{one.name}: read"
    assert ("GainMap" in "".join(str(w.message) for w in told)) == one.opcodes, one.name
    assert "".join(sorted(set(raw.colors))) == "".join(sorted(one.planes)), (one.name, raw.colors)
    # The visible area is the active one, without the first row or column where its corner is odd.
    down, right = (whole - part for whole, part in zip(one.light.shape[1:], raw.counts.shape[1:], strict=True))
    assert {down, right} <= {0, 1}, (one.name, raw.counts.shape)
    order = [one.planes.index(letter) for letter in raw.colors] if raw.pattern is None and one.planes else [0]
    light, count = (array[order, down:, right:] for array in (one.light, one.count))
    error = float((np.abs(raw.mosaic().double().numpy() - light) / count).max())
    assert error <= 0.51, f"{one.name}: {error} counts"
    if raw.pattern is not None:
        letters = np.array(list(raw.colors))[tiled(torch.tensor(raw.pattern), *raw.counts.shape[1:]).numpy()]
        assert (letters == one.letters[down:, right:]).all(), one.name
    if one.planes:
        grey = [float(f) * one.neutral[letter] for f, letter in zip(raw.white_balance, raw.colors, strict=True)]
        np.testing.assert_allclose(grey, grey[0], rtol=1e-5, err_msg=one.name)
    return "read right", error


def count(first=0, last=600):
    """Print how many DNGs were read right, and why the others were refused."""
    outcomes, worst = Counter(), 0.0
    with forked_decoding():
        for seed in range(first, last):
            try:
                what, error = outcome(kind(seed))
            except AssertionError as wrong:
                print(seed, wrong, flush=True)
                what, error = "WRONG", 0.0
            outcomes[re.sub(r"\d+", "N", what)] += 1
            worst = max(worst, error)
    for what, number in outcomes.most_common():
        print(number, what)
    print(f"largest error {worst:.3f} counts")
    return outcomes


if __name__ == "__main__":
    count(*map(int, sys.argv[1:]))
