from __future__ import annotations

import struct

import numpy as np
import pytest

from kornia_tidy.lab.raw.tags import camera_tags, kodak_matrix, tiff_directories
from tests.base import BaseTester, shared
from tests.lab.raw.dng import BYTE, LONG, SRATIONAL, dng

COUNTS = np.random.default_rng(0).integers(64, 1000, (36, 48))


class TestCameraTags(BaseTester):
    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            ("CanonRaw.cr3", ("Canon EOS M50", "EF-M15-45mm f/3.5-6.3 IS STM", 12800, 0.0125, 3.5)),
            ("CanonRaw.cr2", ("Canon EOS 350D DIGITAL", None, 400, 1 / 15, 8)),
            ("FujiFilm.raf", ("FinePix S5Pro", None, 100, 0.004, 8)),
            ("Nikon.nef", ("NIKON D70", None, 200, 0.05, 3.5)),
        ],
    )
    def test_feature_of_cameras(self, name, expected):
        """As ExifTool lists the same files in its own tests."""
        found = camera_tags(shared(f"data/raw/exiftool+exiftool/{name}").read_bytes())
        told = tuple(found.get(key) for key in ("model", "lens", "iso", "exposure", "aperture"))
        assert told == tuple(pytest.approx(x) if isinstance(x, float) else x for x in expected)

    def test_feature_what_makes_no_sense_is_left_out(self):
        extra = {271: (2, b"\0"), 272: (2, b"a\x1b[2J\xff b\0"), 306: (2, b"9999:99:99 99:99:99\0")}
        found = camera_tags(dng(COUNTS, extra=extra))
        assert "make" not in found
        assert found["model"] == "a[2J b"
        assert found["timestamp"] == "2024-02-29T12:34:56"

    @pytest.mark.timeout(60)
    def test_feature_directories_that_name_each_other_are_read_once(self):
        """A ring of two, and one with as many directories below it as there can be."""
        entry = struct.pack("<HHII", 0x014A, LONG, 1, 8)
        ring = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + struct.pack("<I", 8)
        assert len(list(tiff_directories(ring))) == 1
        below = struct.pack("<HHII", 0x014A, LONG, 16000, 26)
        wide = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + below + struct.pack("<I", 0)
        wide += struct.pack("<16000I", *range(26, 16026)) + bytes(range(256)) * 100
        assert len(list(tiff_directories(wide))) == 32

    @pytest.mark.timeout(60)
    def test_feature_directories_that_name_thousands_end_in_time(self):
        """Each of 31 says twice that 16000 others begin where the first does: a million places to look at.

        Before, each was taken from the front of a list.
        """
        number, many = 16000, 31
        places = 8 + 30 * many
        data = b"II*\0" + struct.pack("<I", 8)
        for last in range(1, many + 1):
            below = b"".join(struct.pack("<HHII", tag, LONG, number, places) for tag in (0x014A, 0x8769))
            data += struct.pack("<H", 2) + below + struct.pack("<I", 8 + 30 * last if last < many else 0)
        data += struct.pack(f"<{number}I", *[8] * number)
        assert len(list(tiff_directories(data))) == many

    def test_feature_only_what_is_looked_for_is_kept(self):
        """512 tags of 64 KiB each, all of them the same bytes: a tuple of half a megabyte each in memory."""
        entries = b"".join(struct.pack("<HHII", 1000 + i, BYTE, 65536, 8) for i in range(512))
        data = b"II*\0" + struct.pack("<IH", 8, 512) + entries + bytes(70000)
        assert sum(len(values) for directory in tiff_directories(data) for values in directory.values()) == 0


class TestKodakMatrix(BaseTester):
    def test_feature_matrix_of_kodaks_first_cameras(self):
        values = [0, 1.5, -0.25, -0.25, 0, -0.5, 2, -0.5, 0, 0, -1, 2]
        assert kodak_matrix(dng(COUNTS)) is None
        assert kodak_matrix(dng(COUNTS, extra={0x9218: (SRATIONAL, values[:9])})) is None
        assert kodak_matrix(dng(COUNTS, extra={0x9218: (SRATIONAL, values)})) == [
            [1.5, -0.25, -0.25],
            [-0.5, 2, -0.5],
            [0, -1, 2],
        ]
