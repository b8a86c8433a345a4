"""Sizes that headers promise are refused before memory is taken, and what is compressed does not unfold without limit.

Each file is read in a fork that may take little more memory than it has. All files here have less than 2 MB.
"""

from __future__ import annotations

import functools
import io
import json
import os
import struct
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import torch

from kornia_tidy.data import NYUDepthV2, read_depth, read_image
from kornia_tidy.data.calibration_files import read_calibration
from kornia_tidy.lab.mask_export import read_heights
from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.reconstruction import load_midas_small
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.training.coded_datasets import CodedCaptures
from tests.base import BaseTester
from tests.data.published import write_nyu
from tests.data.tiff_writer import Page, tiff
from tests.forks import fork, wait
from tests.hostile.limited import limit_memory
from tests.lab.raw.dng import dng

ROOM = 160 << 20  # bytes
HUGE = 10**6


def png(width, height, data, *more):
    """A PNG with right check sums; more: chunks before the pixels."""
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0), *more, b"IDAT" + data, b"IEND")
    parts = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def strips(width, height, compression, data, samples=3, **fields):
    """A TIFF of one strip."""
    fields = {256: (4, [width]), 257: (4, [height]), 277: (3, [samples]), 258: (3, [8]), 339: None} | {
        int(tag[1:]): content for tag, content in fields.items()
    }
    return tiff(Page(np.zeros((1, 1, 1)), photometric=2, compression=compression, segments=[data], fields=fields))


def jpeg(width, height):
    frame = struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes((1, 17, 0, 2, 17, 0, 3, 17, 0))
    return b"\xff\xd8\xff\xc0" + frame + b"\xff\xda\x00\x02" + bytes(99) + b"\xff\xd9"


def npy(shape, kind="<f8"):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)


def hdf5(shape, chunks=None, maxshape=None):
    file = io.BytesIO()
    with h5py.File(file, "w") as root:
        root.create_dataset(
            "dataset", shape, "<f4", chunks=chunks, maxshape=maxshape, compression="gzip" if chunks else None
        )
    return file.getvalue()


def safetensors(shape, end):
    header = json.dumps({"masks.phase": {"dtype": "F32", "shape": shape, "data_offsets": [0, end]}}).encode()
    return struct.pack("<Q", len(header)) + header + bytes(64)


def compressed_weights():
    written, packed = io.BytesIO(), io.BytesIO()
    torch.save({"a": torch.zeros(1 << 26)}, written)  # 256 MiB, less than 1 MB compressed
    with zipfile.ZipFile(written) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for part in old.infolist():
            new.writestr(part.filename, old.read(part))
    return packed.getvalue()


@functools.cache
def zeros():
    """Zeros that take half a gigabyte, compressed a thousandfold."""
    packer = zlib.compressobj(9, wbits=-15)
    block = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    adler = (512 << 20) % 65521 << 16 | 1
    return b"\x78\xda" + 512 * block + packer.flush() + struct.pack(">I", adler)


def npz(shape, unfolded):
    """An archive whose array promises a shape, and unfolds into so many bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        member.write(npy(shape)[:-64])
        for _ in range(unfolded >> 20):
            member.write(bytes(1 << 20))
    return file.getvalue()


def exr(data_window, display_window):
    """The header of an OpenEXR file with one channel, and no pixels."""
    channels = b"Z\0" + struct.pack("<iiii", 2, 0, 1, 1) + b"\0"
    fields = (
        (b"channels", b"chlist", channels), (b"compression", b"compression", b"\3"),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"dataWindow", b"box2i", struct.pack("<4i", 0, 0, *data_window)),
        (b"displayWindow", b"box2i", struct.pack("<4i", 0, 0, *display_window)),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)), (b"screenWindowCenter", b"v2f", bytes(8)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    )  # fmt: skip
    header = b"".join(name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data for name, kind, data in fields)
    return b"v/1\x01\2\0\0\0" + header + b"\0" + bytes(999)


PICTURES = {
    "PNG": lambda: png(HUGE, HUGE, zlib.compress(bytes(999))),
    "PNG, compressed": lambda: png(30_000, 30_000, zeros()),
    "TIFF": lambda: strips(HUGE, HUGE, 1, bytes(99)),
    "TIFF, samples": lambda: strips(16_000, 16_000, 1, bytes(99), 65_535),
    "TIFF, values": lambda: strips(16_000, 16_000, 1, bytes(99)),
    "TIFF, Deflate": lambda: strips(16_000, 16_000, 8, zlib.compress(bytes(99))),
    "TIFF, unfolded": lambda: strips(8, 8, 8, zeros()),
    "TIFF, LZW": lambda: strips(16_000, 16_000, 5, bytes(99)),
    "TIFF, Zstandard": lambda: strips(16_000, 16_000, 50_000, bytes(99)),
    "TIFF, LZMA": lambda: strips(16_000, 16_000, 34_925, bytes(99)),
    "TIFF, CCITT": lambda: strips(16_000, 16_000, 4, bytes(99), 1, t258=(3, [1]), t262=(3, [1])),
    "TIFF, JPEG": lambda: strips(16_000, 16_000, 7, jpeg(16_000, 16_000)),
    "TIFF, another JPEG": lambda: strips(8, 8, 7, jpeg(65_535, 65_535)),
    "TIFF, tile": lambda: strips(8, 8, 8, zeros(), t322=(4, [2**31]), t323=(4, [2**31]), t324=(4, [8]), t325=(4, [99])),
    "TIFF, one place for all": lambda: strips(9_000, 9_000, 8, zeros(), t278=(4, [1]), t273=(4, [8] * 9_000),
                                              t279=(4, [1 << 19] * 9_000)),
    "TIFF, strips": lambda: strips(1, 1 << 28, 1, bytes(99), t278=(4, [1])),
    "TIFF, values of a field": lambda: tiff(Page(np.zeros((1, 1, 1)), fields={273: (4, [8])}))
    .replace(struct.pack("<HHI", 273, 4, 1), struct.pack("<HHI", 273, 4, 2**32 - 1)),
    "BigTIFF, fields": lambda: b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, 2**60) + bytes(99),
    "BigTIFF": lambda: b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, 2)
    + b"".join(struct.pack("<HHQQ", tag, 16, 1, 2**40) for tag in (256, 257)) + bytes(99),
    "JPEG": lambda: jpeg(65_535, 65_535),
    "PPM": lambda: b"P6\n1000000 1000000\n255\n" + bytes(99),
    "PGM, plain": lambda: b"P2 1000000 1000000 255\n" + b"0 " * 99,
    "PAM": lambda: b"P7\nWIDTH 16000\nHEIGHT 16000\nDEPTH 1000000\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n" + bytes(99),
    "NPZ": lambda: npz((HUGE, HUGE), 0),
    "NPZ, compressed": lambda: npz((1 << 15, 1 << 14), 1 << 29),
    "NPZ, compressed more than promised": lambda: npz((2, 2), 1 << 29),
    "OpenEXR": lambda: exr((HUGE, HUGE), (99, 99)),
    "OpenEXR, display window": lambda: exr((99, 99), (12_000, 12_000)),
    "OpenEXR, cut short": lambda: exr((12_000, 12_000), (12_000, 12_000)),
    "PFM": lambda: b"PF\n999999999 999999999\n-1.0\n" + bytes(99),
    "BMP": lambda: b"BM" + struct.pack("<IIIIiiHHI", 999, 0, 54, 40, HUGE, HUGE, 1, 24, 0) + bytes(99),
    "WebP": lambda: b"RIFF" + struct.pack("<I", 99) + b"WEBPVP8X" + struct.pack("<II", 10, 0) + b"\xff" * 6 + bytes(99),
    "GIF": lambda: b"GIF89a\xff\xff\xff\xff\x80\0\0" + bytes(99),
    "NPY": lambda: npy((HUGE, HUGE)),
    "NPY, one axis": lambda: npy((10**15,)),
    "HDF5": lambda: hdf5((HUGE, HUGE), (64, 64)),
    "HDF5, not stored": lambda: hdf5((2**31, 2)),
    "HDF5, chunk": lambda: hdf5((4, 4), (1 << 15, 1 << 14), (None, None)),
    "empty": bytes,
}  # fmt: skip


def nyu(folder, kind):
    write_nyu(folder, 1)
    with h5py.File(folder / "nyu_depth_v2_labeled.mat", "a") as file:
        for name, kind_ in (("images", "u1"), ("depths", "f4")):
            shape = file[name].shape
            del file[name]
            if kind == "chunk":
                chunks = (1 << 10, *shape[1:])
                file.create_dataset(name, shape, kind_, chunks=chunks, maxshape=(None, *shape[1:]), compression="gzip")
            else:
                file.create_dataset(name, shape, kind_, external=[("/dev/zero", 0, 10**9)])
    return NYUDepthV2(folder, "all")


def splits(folder):
    write_nyu(folder, 1)
    zeros_ = zeros()
    (folder / "splits.mat").write_bytes(
        (folder / "splits.mat").read_bytes()[:128] + struct.pack("<II", 15, 1 << 20) + zeros_
    )
    return NYUDepthV2(folder, "train")


def place(folder):
    (folder / "index.csv").write_text("key,name,clamped_pixels,coded\n000000,a,0,a.tar:0:900000000000\n")
    (folder / "a.tar").write_bytes(bytes(99))
    return CodedCaptures(folder)[0]


def written(name, data, read):
    """Return what writes a file into a folder and reads it."""

    def written_and_read(folder):
        (folder / name).write_bytes(data)
        return read(folder / name)

    return written_and_read


OTHERS = {
    "safetensors": lambda: written("a.safetensors", safetensors([HUGE, HUGE], 4 * HUGE**2), read_heights),
    "safetensors, no end": lambda: written("a.safetensors", safetensors([2**40, 2**40], 64), read_heights),
    "checkpoint, header": lambda: written("a.safetensors", struct.pack("<Q", 2**62) + bytes(99), read_state),
    "weights, compressed": lambda: written("a.pt", compressed_weights(), load_midas_small),
    "JSON, nested": lambda: written("calib.json", b"[" * HUGE, read_calibration),
    "JSON, a number": lambda: written("calib.json", b'{"scale": 1' + b"0" * HUGE + b"}", read_calibration),
    "NYU Depth, chunk": lambda: lambda folder: nyu(folder, "chunk"),
    "NYU Depth, elsewhere": lambda: lambda folder: nyu(folder, "external"),
    "NYU Depth, split": lambda: splits,
    "index of captures": lambda: place,
    "dump": lambda: written("a.raw", bytes(99), lambda path: RawCapture.open_dump(path, (HUGE, HUGE), "RGGB", 0, 1023)),
}  # fmt: skip


class TestBombs(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("kind", PICTURES)
    @pytest.mark.parametrize("read", [read_image, read_depth])
    def test_exception_pictures(self, kind, read, tmp_path):
        self.check(written("a.png", PICTURES[kind](), read), tmp_path)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("kind", OTHERS)
    def test_exception_other_files(self, kind, tmp_path):
        self.check(OTHERS[kind](), tmp_path)

    def test_exception_a_raw_file_that_promises_a_large_picture(self, tmp_path):
        data = bytearray(dng(np.full((24, 32), 99, np.uint16)))
        for tag in (256, 257, 278):
            place = data.index(struct.pack("<HHI", tag, 4, 1)) + 8
            data[place : place + 4] = struct.pack("<I", 200_000)
        with pytest.raises(ValueError, match="cannot read the raw file"):
            RawCapture.open(bytes(data), memory_limit=1 << 30)

    @pytest.mark.parametrize("chunk", [b"zTXta\0\0", b"iCCPa\0\0", b"iTXta\0\1\0\0\0"])
    def test_feature_compressed_texts_of_a_picture_are_not_unfolded(self, chunk, tmp_path):
        data = png(8, 8, zlib.compress(bytes(8 * 25)), chunk + zeros())
        self.check(written("a.png", data, read_image), tmp_path, refused=False)

    def test_feature_pixels_too_many_are_not_unfolded(self, tmp_path):
        self.check(written("a.png", png(8, 8, zeros()), read_image), tmp_path, refused=None)

    def check(self, read, folder, *, refused=True):
        """Read in a fork with little memory: a sentence that is not of memory, or (None) one or none."""

        def child():
            limit_memory(ROOM)
            code = 0
            try:
                read(folder)
            except (OSError, ValueError) as error:
                (folder / "said").write_text(str(error))
                code = 3
            except BaseException as error:
                (folder / "said").write_text(f"{type(error).__name__}: {error}")
                code = 4
            os._exit(code)

        status = wait(fork(child))
        said = (folder / "said").read_text() if (folder / "said").exists() else ""
        assert status in ({3} if refused else {0, 3} if refused is None else {0}), said
        if status:
            assert "memory" not in said
            assert len(said) < 500
