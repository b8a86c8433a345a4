"""Seeded DNGs with random properties, and the light and colours that a reader must find in them.

`python -m tests.lab.raw.dng_kinds 0 3000` reads as many and prints how many were read right and which were refused.
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

from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.filter_array import tiled
from tests.lab.raw.dng import BYTE, LONG, RATIONAL, SHORT, SRATIONAL, UNDEFINED, XTRANS, dng
from tests.lab.raw.forked import forked_decoding

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


class Draw:
    """A seeded choice of properties."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)

    def pick(self, *choices):
        return choices[self.random.integers(len(choices))]

    def whole(self, low, high):
        return int(self.random.integers(low, high))

    def chance(self, share):
        return self.random.random() < share

    def shuffled(self, letters):
        return "".join(self.random.permutation(list(letters)))


def kind(seed):
    """Return the DNG of a seed; about one in eight is of a kind that must be refused."""
    draw, extra = Draw(seed), {}
    order, (height, width) = draw.pick("<", ">"), (draw.whole(30, 60), draw.whole(30, 60))
    top, left = draw.pick((0, 0), (draw.whole(0, 7), draw.whole(0, 7)))
    bottom, right = height - draw.whole(0, 3), width - draw.whole(0, 3)
    area = (bottom - top, right - left)
    array, tile, planes, named, samples = _colors(draw, extra)
    neutral = {letter: round(float(draw.random.uniform(0.4, 1)), 2) for letter in named}
    floating = draw.chance(0.25)
    bits = draw.pick(16, 24, 32) if floating else draw.pick(8, 10, 12, 14, 16, 16, 16)
    compression = draw.pick(1, 1, 8) if floating or bits in {8, 16} else draw.pick(1, 7 if samples == 1 else 1)
    separate = samples > 1 and draw.chance(0.5)
    fault = _fault(draw, extra, tile, floating, separate, samples)
    compression, floating, bits = (7, False, 16) if fault and "JPEG" in fault else (compression, floating, bits)
    white, whites, level = _levels(draw, extra, area, samples, floating, bits)

    # The stored picture, whose borders hold anything
    span = np.array(whites) - level
    light = draw.random.uniform(-0.02, 40 if floating and bits > 16 else 1.05, (*area, samples))
    stored = draw.random.uniform(0, white, (height, width, samples))
    stored[top:bottom, left:right] = level + light * span
    table = np.arange(2**16)
    if floating:
        stored = seen = _floats(stored, bits)
    else:
        stored = stored.round().clip(0, 2**bits - 1).astype(np.uint16)
        if bits < 16 and draw.chance(0.3):
            table = np.sort(draw.random.integers(0, white, 2**bits)) if bits < 12 else np.arange(2**bits) // 2 * 2
            extra[50712] = (SHORT, table.tolist())
        seen = table[stored]
    seen = seen[top:bottom, left:right].astype(float)
    if fault == "not finite":
        stored[top + 3, left + 5, 0] = draw.pick(np.nan, np.inf)
    if (top, left, *area) != (0, 0, height, width) or draw.chance(0.3):
        extra[50829] = (LONG, [top, left, bottom, right])
        extra[50719] = (LONG, [1, 3])  # DefaultCropOrigin, which changes nothing
        if left:
            extra[50830] = (LONG, [0, 0, height, left])  # MaskedAreas, likewise, as the black level is given
    if draw.chance(0.2):
        extra[51009] = (UNDEFINED, gain_map())
    blocks = _stored(stored, bits, floating, compression, separate, order, draw, extra, fault)
    extra |= {258: (SHORT, [bits] * samples), 259: (SHORT, [compression]), 284: (SHORT, [2 if separate else 1])}
    extra[339] = (SHORT, [3 if floating else 1] * samples)
    told = {"neutral": [neutral[p] for p in named], "matrix": np.eye(len(named), 3).ravel().tolist()}
    told |= {"orientation": draw.whole(1, 9), "order": order, "extra": extra}
    data = dng(stored[..., 0] if samples == 1 else stored, None if tile is None else "", **told, **blocks)

    plain = tile is None or len(np.unique(tile)) == 1
    y, x = np.mgrid[: area[0], : area[1]]
    count = np.maximum(1e-4 * white, abs(seen)) * 2.0**-11 if floating else 1
    name = (
        f"{array}, {samples} of {bits} {'float' if floating else 'integer'} bits, {order}, compression {compression}, "
    )
    name += f"{len(blocks['blocks'])} {'tiles' if blocks['tiles'] else 'strips'}{' in planes' if separate else ''}, "
    name += f"corner {top} {left}, black {extra[50713][1]}, tags {sorted({50712, 50715, 50716} & set(extra))} {fault}"
    return Kind(
        name,
        data,
        light=((seen - level) / span).transpose(2, 0, 1),
        count=np.broadcast_to(count / span, span.shape).transpose(2, 0, 1),
        letters=None if plain else tile[y % tile.shape[0], x % tile.shape[1]],
        planes="" if tile is not None and plain else planes,
        neutral=neutral,
        opcodes=51009 in extra,
        fault=fault,
    )


def _colors(draw, extra):
    """Return the kind of array, its tile, its planes, their names in the file, and the number of samples."""
    array = draw.pick(
        "Bayer", "Bayer", "Bayer", "permuted", "four", "quad", "X-Trans", "3x3", "2x4", "one colour", "linear", "linear"
    )
    planes, samples = "RGB", 1
    if array == "permuted":
        planes = draw.pick("RGB", "RYB", "CMY", "RWB")
    elif array == "four":
        planes = draw.shuffled(draw.pick("RGBW", "RGBC", "GMCY", "RGBY", "WCMY"))
    elif array == "quad":
        planes = draw.pick("RGB", "RGBW")
    elif array == "linear":
        planes = draw.pick("", "RGB", "BGR", "RGBW", "GMCY")
        samples = max(1, len(planes))
    letters, shape = {
        "Bayer": (draw.pick("RGGB", "BGGR", "GRBG", "GBRG"), (2, 2)),
        "permuted": (draw.shuffled(planes + draw.pick(*planes or "G")), (2, 2)),
        "four": (draw.shuffled(planes), (2, 2)),
        "quad": (QUAD if planes == "RGB" else QUAD_WHITE, (4, 4)),
        "X-Trans": (XTRANS, (6, 6)),
        "3x3": (draw.shuffled("RGBGGGRBG"), (3, 3)),
        "2x4": (draw.shuffled("RGBGGRGB"), draw.pick((2, 4), (4, 2))),
        "one colour": (draw.pick("G", "RRRR"), (1, 1)),
        "linear": (None, None),
    }[array]
    named = planes or "RGB"
    if array in {"Bayer", "X-Trans", "permuted"} and draw.chance(0.3):
        named = planes = draw.shuffled(planes)
    if named != "RGB" or draw.chance(0.5):
        extra[50710] = (BYTE, [CODES.index(letter) for letter in named])
    if letters is None:
        return array, None, planes, named, samples
    shape = (2, 2) if letters == "RRRR" else shape
    tile = np.array(list(letters)).reshape(shape)
    if array in {"quad", "X-Trans"}:
        tile = np.roll(tile, draw.random.integers(0, 6, 2), (0, 1))
    extra[33421] = (SHORT, list(shape))
    extra[33422] = (BYTE, [CODES.index(letter) for letter in tile.ravel()])
    extra[50711] = (SHORT, [1])
    return array, tile, planes, named, samples


def _fault(draw, extra, tile, floating, separate, samples):
    """Return what must be refused, with its tags written, or None."""
    dead = dict.fromkeys(("staggered", "period", "two colours"), tile is not None)
    dead |= {"separate JPEG": separate, "strips of JPEG": not separate and samples == 1, "not finite": floating}
    fault = draw.pick(*[name for name, possible in dead.items() if possible] or [None]) if draw.chance(0.12) else None
    if fault == "staggered":
        extra[50711] = (SHORT, [2])
    elif fault in {"period", "two colours"}:
        side, codes = (5, ([0, 1, 2] * 9)[:25]) if fault == "period" else (2, [0, 1, 1, 0])
        extra |= {33421: (SHORT, [side, side]), 33422: (BYTE, codes), 50710: (BYTE, [0, 1, 2])}
    return fault


def _levels(draw, extra, area, samples, floating, bits):
    """Return the usual white level, that of each sample, and the black level of each sample of the active area."""
    white = 1 if floating and draw.chance(0.5) else int(0.9 * (2 ** min(bits, 16) - 1))
    unit = white / 1024 if floating else 1
    repeat = draw.pick((1, 1), (1, 1), (2, 2), (1, 2), (2, 1), (4, 4), (3, 3), (6, 6), (5, 2))
    number = 1 if repeat == (1, 1) and draw.chance(0.4) else repeat[0] * repeat[1] * samples
    step = draw.pick(1, 0.25)
    black = np.round(draw.random.uniform(0, 0.15 * white / unit, number) / step) * step * unit
    black *= draw.pick(0, 1, 1, 1, 1, 1)
    whites = [white] * samples
    if samples > 1 and white > 1 and draw.chance(0.4):
        whites = draw.random.integers(white * 3 // 4, white, samples).tolist()
    extra |= {50713: (SHORT, list(repeat)), 50714: (RATIONAL, black.tolist()), 50717: (LONG, whites)}
    y, x = np.mgrid[: area[0], : area[1]]
    level = np.resize(black, (*repeat, samples))[y % repeat[0], x % repeat[1]]
    for axis, tag in ((1, 50715), (0, 50716)):
        if draw.chance(0.12):
            values = np.round(draw.random.uniform(-3, 3, area[axis]) / step) * step * unit
            extra[tag] = (SRATIONAL, values.tolist())
            level = level + (values[None, :, None] if axis else values[:, None, None])
    return white, whites, level


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
    height, width, _ = stored.shape
    tiled = draw.chance(0.4) and fault != "strips of JPEG"
    if tiled:
        rows, columns = 16 * draw.whole(1, 5), 16 * draw.whole(1, 5)
        columns = min(columns, 16) if compression == 7 else columns  # LibRaw cannot decode wider ones than the picture
        extra[322], extra[323] = (LONG, [columns]), (LONG, [rows])
        extra[278] = None
    else:
        rows, columns = draw.whole(5, height + 9), width
        if compression == 7:
            rows = height // 3 if fault == "strips of JPEG" else height
        extra[278] = (LONG, [rows])
    predictor = 1
    if compression == 8:
        choices = [1, 3, 34894, 34895] if floating else [1, 2, 34892, 34893]
        predictor = draw.pick(*choices[: 2 if columns % 4 else 4])
        extra[317] = (SHORT, [predictor])
    planes = stored.transpose(2, 0, 1)[..., None] if separate else stored[None]
    blocks = []
    for plane, y, x in itertools.product(planes, range(0, height, rows), range(0, width, columns)):
        block = plane[y : y + rows, x : x + columns]
        if tiled:
            block = np.pad(block, ((0, rows - block.shape[0]), (0, columns - block.shape[1]), (0, 0)), "edge")
        blocks.append(_encoded(block, bits, floating, compression, predictor, order))
    most = draw.pick(1, 1, 40)
    gaps = [draw.whole(0, most) for _ in blocks]
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
        assert re.search(CONTRADICTIONS.get(one.fault, "nothing"), sentence), (one.name, sentence)
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
