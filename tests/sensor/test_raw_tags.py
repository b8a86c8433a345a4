from __future__ import annotations

import struct
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kornia_tidy.sensor.raw_tags import black_tile, camera_tags, kodak_matrix, missing_bytes, tiff_directories
from tests.base import BaseTester, shared
from tests.sensor.dng import LONG, SHORT, SRATIONAL, dng

COUNTS = np.random.default_rng(0).integers(64, 1000, (36, 48))


class TestCameraTags(BaseTester):
    @pytest.mark.parametrize("order", ["<", ">"])
    def test_smoke(self, order):
        assert camera_tags(dng(COUNTS, order=order)) == {
            "make": "Maker",
            "model": "Model One",
            "lens": "Prime 35",
            "iso": 400,
            "exposure": 0.04,
            "aperture": 2.8,
            "focal_length": 0.035,
            "timestamp": "2024-02-29T12:34:56",
        }

    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            ("CanonRaw.cr3", ("Canon EOS M50", "EF-M15-45mm f/3.5-6.3 IS STM", 12800, 0.0125, 3.5)),
            ("CanonRaw.cr2", ("Canon EOS 350D DIGITAL", None, 400, 1 / 15, 8)),
            ("FujiFilm.raf", ("FinePix S5Pro", None, 100, 0.004, 8)),
            ("Nikon.nef", ("NIKON D70", None, 200, 0.05, 3.5)),
            ("CanonRaw.crw", ("Canon EOS DIGITAL REBEL", None, None, None, None)),
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

    @given(
        st.binary(max_size=400), st.sampled_from([b"", b"II*\0\x08\0\0\0", b"MM\0*\0\0\0\x08", b"II\x1a\0\0\0HEAPCCDR"])
    )
    @settings(max_examples=300, deadline=None)
    def test_feature_any_bytes_end_well(self, data, start):
        found = camera_tags(start + data)
        assert set(found) <= {"make", "model", "lens", "iso", "exposure", "aperture", "focal_length", "timestamp"}
        assert missing_bytes(start + data) >= 0
        black_tile(start + data)
        kodak_matrix(start + data)

    @example([(15, 4)])  # a tag without values
    @given(st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), max_size=30))
    @settings(max_examples=200, deadline=None)
    def test_feature_a_damaged_header_ends_well(self, changes):
        data = bytearray(dng(COUNTS))
        for place, value in changes:
            data[place] = value
        camera_tags(bytes(data))
        black_tile(bytes(data))
        kodak_matrix(bytes(data))
        assert missing_bytes(bytes(data)) >= 0

    def test_feature_directories_that_name_each_other_are_read_once(self):
        """A ring of two, and one with as many directories below it as there can be."""
        entry = struct.pack("<HHII", 0x014A, LONG, 1, 8)
        ring = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + struct.pack("<I", 8)
        assert len(list(tiff_directories(ring))) == 1
        below = struct.pack("<HHII", 0x014A, LONG, 16000, 26)
        wide = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + below + struct.pack("<I", 0)
        wide += struct.pack("<16000I", *range(26, 16026)) + bytes(range(256)) * 100
        start = time.perf_counter()
        assert len(list(tiff_directories(wide))) == 32
        assert time.perf_counter() - start < 5


class TestLevelsAndLengths(BaseTester):
    def test_feature_black_of_a_large_tile(self):
        assert black_tile(dng(COUNTS)) is None
        assert black_tile(dng(COUNTS, black=(1, 2, 3, 4), black_repeat=(2, 2))) is None  # LibRaw tells that
        assert black_tile(dng(COUNTS, black=range(8), black_repeat=(2, 4))) == [[0, 1, 2, 3], [4, 5, 6, 7]]
        assert black_tile(dng(COUNTS, black=range(7), black_repeat=(2, 4))) is None

    def test_feature_missing_bytes(self):
        data = dng(COUNTS)
        assert missing_bytes(data) == 0
        assert missing_bytes(data[:-100]) == 100
        assert missing_bytes(dng(COUNTS, extra={254: (SHORT, [1])})[:-100]) == 0  # a preview may lie anywhere

    def test_feature_matrix_of_kodaks_first_cameras(self):
        values = [0, 1.5, -0.25, -0.25, 0, -0.5, 2, -0.5, 0, 0, -1, 2]
        assert kodak_matrix(dng(COUNTS)) is None
        assert kodak_matrix(dng(COUNTS, extra={0x9218: (SRATIONAL, values[:9])})) is None
        assert kodak_matrix(dng(COUNTS, extra={0x9218: (SRATIONAL, values)})) == [
            [1.5, -0.25, -0.25],
            [-0.5, 2, -0.5],
            [0, -1, 2],
        ]
