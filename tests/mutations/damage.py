"""Ways to damage a file: blindly, by the numbers of its header, and by the structure of the JSON in it."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

Generator = np.random.Generator
Damage = Callable[[bytes, Generator], bytes]

NUMBERS = (0, 1, 2, 3, 7, 255, 256, 32767, 65535, 10**6, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
DEEP = 100_000
TEXTS = (
    "", "nan", "x", "../*", "../../*.png", "/etc/*", "*", "**", "a" * 5000, "\0", "\ud800", "mm", "1e9", "$tensor",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 0.5, 10**6, 10**9, 2**63, 10**400, 1e308, -1e308, 1e-320, float("nan"), float("inf"),
    [], {}, [[]], [1, 2], {"a": 1}, {"$tensor": "none"}, {"$tuple": 3}, {"$pairs": [[1]]}, *TEXTS,
)  # fmt: skip


def pick(generator: Generator, values: Any) -> Any:
    return values[int(generator.integers(len(values)))]


# ---------------------------------------------------------------------- blind


def flipped(data: bytes, generator: Generator) -> bytes:
    """Some bits turned over."""
    array = np.frombuffer(data, np.uint8).copy()
    for place in generator.integers(0, 8 * len(array), int(generator.integers(1, 9))):
        array[place // 8] ^= 1 << (place % 8)
    return array.tobytes()


def flipped_early(data: bytes, generator: Generator) -> bytes:
    """One bit turned over where headers are."""
    head = min(len(data), int(pick(generator, (64, 256, 2048))))
    return flipped_once(data[:head], generator) + data[head:]


def flipped_once(data: bytes, generator: Generator) -> bytes:
    array = np.frombuffer(data, np.uint8).copy()
    place = int(generator.integers(8 * len(array)))
    array[place // 8] ^= 1 << (place % 8)
    return array.tobytes()


def overwritten(data: bytes, generator: Generator) -> bytes:
    """Some bytes replaced."""
    array = np.frombuffer(data, np.uint8).copy()
    within = len(array) if generator.random() < 0.5 else min(len(array), 128)
    places = generator.integers(0, within, int(generator.integers(1, 17)))
    array[places] = generator.integers(0, 256, len(places))
    return array.tobytes()


def cut(data: bytes, generator: Generator) -> bytes:
    """The end is missing."""
    return data[: int(generator.integers(0, len(data)))]


def inserted(data: bytes, generator: Generator) -> bytes:
    """Bytes too many, in the middle or at the end."""
    place = int(generator.integers(0, len(data) + 1)) if generator.random() < 0.8 else len(data)
    return data[:place] + generator.bytes(int(generator.integers(1, 65))) + data[place:]


def removed(data: bytes, generator: Generator) -> bytes:
    """A block is missing in the middle."""
    begin = int(generator.integers(0, len(data)))
    return data[:begin] + data[begin + int(generator.integers(1, 257)) :]


def emptied(data: bytes, generator: Generator) -> bytes:
    """A block of zeros, as a disk leaves that was not written."""
    begin, size = int(generator.integers(0, len(data))), int(generator.integers(1, 4097))
    end = min(len(data), begin + size)
    return data[:begin] + bytes(end - begin) + data[end:]


def number(data: bytes, generator: Generator) -> bytes:
    """A number of 16 or 32 bits somewhere at the beginning is another."""
    form = str(pick(generator, ("<H", ">H", "<I", ">I")))
    place = int(generator.integers(0, max(1, min(len(data), 512) - 4)))
    value = int(pick(generator, NUMBERS)) & (0xFFFF if form[1] == "H" else 0xFFFFFFFF)
    coded = struct.pack(form, value)
    return data[:place] + coded + data[place + len(coded) :]


BLIND: tuple[Damage, ...] = (flipped, flipped_early, overwritten, cut, inserted, removed, emptied, number)


# ---------------------------------------------------------------------- by their headers


def npy_header(data: bytes, generator: Generator) -> bytes:
    """Another data type, order or shape, in a header of the right length."""
    end = 10 + struct.unpack_from("<H", data, 8)[0]
    header = data[10:end].decode("latin-1")
    kind = header.split("'descr': '")[1].split("'")[0]
    shape = header.split("'shape': ")[1].split(", }")[0]
    kinds = (
        "|O",
        "<f8",
        ">f4",
        "<f2",
        "<c16",
        "|b1",
        "<i8",
        "|u1",
        "|S5",
        "<U3",
        "<M8[s]",
        "|V4",
        "<f99",
        "zz",
        "",
        "f,i",
    )
    shapes = (
        "()", "(0,)", "(-1, 5)", "(1000000, 1000000)", "(4294967296, 4294967296)", "(99999999999999999999,)",
        "(1000000000,)", "(1, 1, 1, 1, 1)", "(2.5,)", "'x'", "None", "(" * 3000, "(True, True)", "(1_0, 10)", "[3, 4]",
        "(10L, 10L)", "(010,)", "(1" + ",1" * 70 + ")", "({},)", "(" + "9" * 5000 + ",)", "(48,",
    )  # fmt: skip
    if generator.random() < 0.4:
        header = header.replace(f"'{kind}'", f"'{pick(generator, kinds)}'")
    else:
        header = header.replace(shape, str(pick(generator, shapes)))
    coded = header.rstrip().encode("latin-1") + b"\n"
    return data[:8] + struct.pack("<H", len(coded) & 0xFFFF) + coded + data[end:]


def png_header(data: bytes, generator: Generator) -> bytes:
    """Another size, depth or colour type, with the right check sum."""
    header = list(struct.unpack_from(">IIBBBBB", data, 16))
    which = int(generator.integers(7))
    choices = NUMBERS if which < 2 else (0, 1, 2, 3, 4, 6, 8, 16, 255)
    header[which] = int(pick(generator, choices))
    if generator.random() < 0.3:
        header[0] = header[1] = int(pick(generator, (10**4, 2 * 10**4, 10**6)))
    coded = b"IHDR" + struct.pack(">IIBBBBB", *header)
    return data[:12] + coded + struct.pack(">I", zlib.crc32(coded)) + data[33:]


def png_lines(data: bytes, generator: Generator) -> bytes:
    """Pixel data that end too early or are no pixel data, with the right check sum."""
    begin = data.index(b"IDAT")
    (size,) = struct.unpack_from(">I", data, begin - 4)
    packed = data[begin + 4 : begin + 4 + size]
    packed = (cut, flipped, emptied)[int(generator.integers(3))](packed, generator)
    chunk = b"IDAT" + packed
    tail = data[begin + 8 + size :]
    return data[: begin - 4] + struct.pack(">I", len(packed)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + tail


def tiff_field(data: bytes, generator: Generator) -> bytes:
    """A field of the first directory, or the link to the next one, is of another number, type or value."""
    order, big = "<" if data[:2] == b"II" else ">", b"+" in data[:4]
    offset, length, head = ("Q", 20, 8) if big else ("I", 12, 2)
    (place,) = struct.unpack_from(f"{order}{offset}", data, 8 if big else 4)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, place)
    entry = place + head + length * int(generator.integers(count + 1))
    size = struct.calcsize(offset)
    array, link = bytearray(data), entry == place + head + length * count
    changes = [(0, offset)] if link else [(0, "H"), (2, "H"), (4, offset), (4 + size, offset), (4 + size, "H")]
    where, form = pick(generator, changes)
    value = int(generator.integers(0, 20)) if (where, form) == (2, "H") else int(pick(generator, (*NUMBERS, len(data))))
    struct.pack_into(f"{order}{form}", array, entry + where, value % 2 ** (8 * struct.calcsize(form)))
    return bytes(array)


def jpeg_segment(data: bytes, generator: Generator) -> bytes:
    """Another size of the picture, or a segment of another length; or an end before its time."""
    places = [
        i for i in range(2, len(data) - 9) if data[i] == 0xFF and data[i + 1] in {0xC0, 0xC2, 0xC4, 0xDA, 0xDB, 0xE0}
    ]
    place = int(pick(generator, places))
    array = bytearray(data)
    if generator.random() < 0.2:
        middle = int(generator.integers(len(data) // 2, len(data)))
        return data[:middle] + b"\xff\xd9"
    offset = int(pick(generator, (2, 5, 7)))
    struct.pack_into(">H", array, place + offset, int(pick(generator, NUMBERS)) & 0xFFFF)
    return bytes(array)


def text_header(data: bytes, generator: Generator) -> bytes:
    """A word of the header of a PFM or PGM file is another."""
    lines = data.split(b"\n", 3)
    words = b" ".join(lines[:3]).split()
    choices = (
        b"",
        b"0",
        b"-1",
        b"1000000",
        b"999999999",
        b"99999999999999",
        b"nan",
        b"1e999",
        b"-.",
        b"PF",
        b"+",
        b"\xff",
    )
    words[int(generator.integers(len(words)))] = pick(generator, choices)
    return b"\n".join([words[0], b" ".join(words[1:-1]), words[-1], lines[3] if len(lines) > 3 else b""])


def pam_line(data: bytes, generator: Generator) -> bytes:
    """A line of the header of a PAM file is another, is missing, or is there twice."""
    lines = data.split(b"ENDHDR\n")[0].split(b"\n")
    place = int(generator.integers(1, len(lines)))
    name = pick(generator, (b"WIDTH", b"HEIGHT", b"DEPTH", b"MAXVAL", b"TUPLTYPE", b"#", b"", b"WIDE"))
    words = (b"0", b"-1", b"1", b"4", b"255", b"256", b"65535", b"65536", b"99999999999", b"RGB", b"CMYK", b"", b"\xff")
    new = [name + b" " + bytes(pick(generator, words))]
    changed = [*lines[:place], *(new if generator.random() < 0.8 else []), *lines[place + int(generator.integers(2)) :]]
    return b"\n".join(changed) + data[len(b"\n".join(lines)) :]


def tensors_header(data: bytes, generator: Generator) -> bytes:
    """The JSON that a safetensors file begins with, damaged in its structure, under the right length."""
    (size,) = struct.unpack_from("<Q", data)
    header = json_structure(data[8 : 8 + size], generator)
    return struct.pack("<Q", len(header)) + header + data[8 + size :]


def stored_state(data: bytes, generator: Generator) -> bytes:
    """The settings in a checkpoint, which are JSON in the JSON of the header."""
    (size,) = struct.unpack_from("<Q", data)
    header = json.loads(data[8 : 8 + size])
    text = header["__metadata__"]["state"].encode()
    damage = pick(generator, (json_structure, json_structure, flipped_once, cut))
    header["__metadata__"]["state"] = damage(text, generator).decode("utf-8", "replace")
    coded = json.dumps(header).encode()
    return struct.pack("<Q", len(coded)) + coded + data[8 + size :]


# ---------------------------------------------------------------------- by the structure of JSON


def json_structure(data: bytes, generator: Generator) -> bytes:
    """A value of a JSON document is another, is missing, or is there under another name; or it is nested too deep."""
    document = json.loads(data)
    if generator.random() < 0.05:
        deep = "[" * DEEP + "]" * DEEP if generator.random() < 0.5 else '{"a":' * DEEP + "1" + "}" * DEEP
        text = json.dumps({**document, "deep": "@"}).replace('"@"', deep) if generator.random() < 0.5 else deep
        return text.encode()
    node, place = _somewhere(document, generator)
    act = int(generator.integers(5))
    if act == 0:
        del node[place]
    elif act == 1 and isinstance(node, dict):
        node[pick(generator, TEXTS)] = node.pop(place)
    elif act == 2 and isinstance(node[place], (int, float)) and not isinstance(node[place], bool):
        node[place] = node[place] * pick(generator, (-1, 1000, 10**9, 0.5))
    else:
        node[place] = pick(generator, VALUES)
    return json.dumps(document).encode("utf-8", "surrogatepass")


def json_text(data: bytes, generator: Generator) -> bytes:
    """One character is another."""
    return flipped_once(data, generator)


def _somewhere(document: Any, generator: Generator) -> tuple[Any, Any]:
    """A container and where in it, all levels alike."""
    node, place = document, None
    while True:
        places = list(node) if isinstance(node, dict) else list(range(len(node)))
        place = pick(generator, places)
        inner = node[place]
        if not isinstance(inner, (dict, list)) or not inner or generator.random() < 0.35:
            return node, place
        node = inner


BY_KIND: dict[str, tuple[Damage, ...]] = {
    "npy": (npy_header,),
    "png": (png_header, png_lines),
    "tiff": (tiff_field,),
    "jpeg": (jpeg_segment,),
    "pfm": (text_header,),
    "pam": (pam_line,),
    "safetensors": (tensors_header,),
    "checkpoint": (tensors_header, stored_state, stored_state),
    "json": (json_structure, json_structure, json_text),
    "raw": (),
    "npz": (),  # see tests.mutations.reading for its structure, and for that of OpenEXR
    "exr": (),
}
