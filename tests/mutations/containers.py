"""Damage to text tables, HDF5 and OpenEXR files, tar and NPZ archives, by their structure."""

from __future__ import annotations

import io
import struct
import tempfile
import zipfile
from pathlib import Path

import h5py
import numpy as np

from tests.mutations.damage import BLIND, NUMBERS, TEXTS, Generator, npy_header, pick

WORDS = (
    *(str(number) for number in (*NUMBERS, -1, 10**12, 10**30)), *TEXTS, "1e400", "-inf", "/etc/passwd", "a.tar:0:9",
    "00000.tar:0:1000000000000", "00000.tar:-5:3", f"00000.tar:{10**30}:{10**30}", "/dev/zero:0:99", ".", "..",
    "\ufeff", "\u0661", '"', "'", ",", "\r", "#", "[1 2", "0x10", "1_0", "\U0001f600",
)  # fmt: skip


def text_word(data: bytes, generator: Generator) -> bytes:
    """One word between blanks, commas, colons or brackets is another."""
    text = data.decode("utf-8", "replace")
    edges = [-1, *(i for i, letter in enumerate(text) if letter in " \t\n,=;:[]"), len(text)]
    place = int(generator.integers(len(edges) - 1))
    word = str(pick(generator, WORDS))
    return f"{text[: edges[place] + 1]}{word}{text[edges[place + 1] :]}".encode("utf-8", "surrogatepass")


def text_line(data: bytes, generator: Generator) -> bytes:
    """A line is missing, twice there, empty, or longer than a reader of CSV takes."""
    lines = data.splitlines(keepends=True) or [b""]
    place, act = int(generator.integers(len(lines))), int(generator.integers(5))
    if act == 0:
        del lines[place]
    elif act == 1:
        lines.insert(place, lines[place])
    elif act == 2:
        lines.insert(place, b"\n")
    elif act == 3:
        lines.insert(place, bytes(200_000) + b"\n")  # as a disk leaves that was not written
    else:
        lines[place] = lines[place].replace(b",", b";")
    return b"".join(lines)


def hdf5_structure(data: bytes, generator: Generator) -> bytes:
    """Another data set under the name: of another type or shape, elsewhere, or a link."""
    act = int(generator.integers(9))
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "a.h5"
        path.write_bytes(data)
        with h5py.File(path, "a") as file:
            name = str(pick(generator, list(file)))
            shape = file[name].shape
            del file[name]
            if act == 0:  # nothing is stored: a few hundred bytes tell of terabytes
                side = int(pick(generator, (10**5, 10**6, 2**31)))
                file.create_dataset(name, (side, side), "<f4", chunks=(64, 64), compression="gzip")
            elif act == 1:
                file.create_dataset(name, (10**9,), h5py.string_dtype(), chunks=(1024,))
            elif act == 2:
                file.create_dataset(name, data=["a", "b"], dtype=h5py.string_dtype())
            elif act == 3:
                file[name] = h5py.SoftLink(str(pick(generator, ("/nothing", f"/{name}", "/"))))
            elif act == 4:
                file[name] = h5py.ExternalLink(str(pick(generator, ("/etc/passwd", "depth.hdf5", "nothing"))), "/")
            elif act == 5:
                file.create_dataset(name, shape, "u1", external=[("/etc/passwd", 0, 10**9)])
            elif act == 6:
                file.create_group(name)
            elif act == 7:
                file.create_dataset(name, data=np.zeros(3, [("a", "<f4"), ("b", "<i2")]))
            else:
                kind = str(pick(generator, ("c8", "i1", "f2", "u8", "S3", "f8")))
                sides = pick(generator, ((), (0,), (0, 5), (1, 1, 1, 1, 1), shape[::-1], (4, 4)))
                file.create_dataset(name, data=np.zeros(sides, kind))
        return path.read_bytes()


def tar_header(data: bytes, generator: Generator) -> bytes:
    """A field of one of the headers is another; its check sum is right in half of the cases."""
    array = bytearray(data)
    headers = [i for i in range(0, len(data), 512) if data[i + 257 : i + 262] == b"ustar"]
    if not headers:
        return bytes(array)
    begin = int(pick(generator, headers))
    offset, width = ((0, 100), (124, 12), (156, 1), (257, 6), (345, 155))[int(generator.integers(5))]
    value = (b"a" * width, b"77777777777", b"-1", b"", b"\xff" * width, b"x", b"L", b"S", b"../x")[
        int(generator.integers(9))
    ]
    array[begin + offset : begin + offset + width] = value[:width].ljust(width, b"\0")
    if generator.random() < 0.5:
        array[begin + 148 : begin + 156] = b" " * 8
        array[begin + 148 : begin + 156] = b"%06o\0 " % sum(array[begin : begin + 512])
    return bytes(array)


def npz_member(data: bytes, generator: Generator) -> bytes:
    """An archive of another array, of several, of another method, or with other sizes in its directories."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        name, array = archive.namelist()[0], archive.read(archive.namelist()[0])
    act = int(generator.integers(5))
    if act == 0:
        array = npy_header(array, generator)
    elif act == 1:
        array = pick(generator, BLIND)(array, generator)
    file = io.BytesIO()
    method = int(pick(generator, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
    with zipfile.ZipFile(file, "w", method if act == 2 else zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, array)
        for other in range(int(generator.integers(3)) if act == 3 else 0):
            archive.writestr(
                str(pick(generator, (name, "../a.npy", f"{other}.npy", "a/", "\udcff.npy", ""))) or "x", array
            )
    packed = bytearray(file.getvalue())
    if act == 4:
        begin = packed.index(b"PK\1\2") if generator.random() < 0.6 else 0
        offset, form = pick(
            generator, ((8, "<H"), (10, "<H"), (16, "<I"), (20, "<I"), (24, "<I"), (42, "<I"), (26, "<H"))
        )
        value = int(pick(generator, NUMBERS)) % 2 ** (8 * struct.calcsize(form))
        struct.pack_into(form, packed, begin + offset, value)
    return bytes(packed)


def exr_attribute(data: bytes, generator: Generator) -> bytes:
    """A number in an attribute of the header, or in the table of chunks behind it, is another."""
    array, places = bytearray(data), []
    for kind in (b"box2i", b"chlist", b"compression", b"lineOrder", b"tiledesc", b"int", b"v2f", b"string", b"float"):
        place = -1
        while (place := data.find(b"\0" + kind + b"\0", place + 1)) >= 0:
            begin = place + len(kind) + 2
            (length,) = struct.unpack_from("<i", data, begin)
            places += [begin, *range(begin + 4, begin + 4 + min(max(0, length), 400))]
    table = data.find(b"\0\0", places[-1]) + 2 if places else 0
    place = int(pick(generator, places)) if generator.random() < 0.8 else table + int(generator.integers(64))
    form = str(pick(generator, ("<B", "<i", "<Q")))
    value = int(pick(generator, (*NUMBERS, 4, 5, 6, 9, 31, 52, 64))) % 2 ** (7 if form == "<B" else 31)
    struct.pack_into(form, array, min(place, len(array) - 8), value)
    return bytes(array)
