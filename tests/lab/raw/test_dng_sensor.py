from __future__ import annotations

import re
import struct

import numpy as np
import pytest
import tifffile
import torch

from kornia_tidy.lab.raw import RawCapture, develop
from kornia_tidy.lab.raw.dng_sensor import dng_sensor, ignored_opcodes, missing_bytes
from kornia_tidy.lab.raw.dng_writer import encode_dng
from kornia_tidy.lab.raw.tags import tiff_directories
from tests.base import BaseTester, shared
from tests.lab.raw.dng import BYTE, LONG, RATIONAL, SHORT, UNDEFINED, XTRANS, dng, patched
from tests.lab.raw.dng_kinds import gain_map
from tests.lab.raw.test_capture import README

REPEAT, PATTERN, COLORS, LAYOUT = 33421, 33422, 50710, 50711
COUNTS = np.random.default_rng(0).integers(64, 1000, (36, 48))


def sensor(data):
    return dng_sensor(data, list(tiff_directories(data)))


def fault(data):
    with pytest.raises(ValueError, match=r"^its ") as refused:
        sensor(data)
    return str(refused.value)


def missing(data):
    return missing_bytes(data, list(tiff_directories(data)))


class TestFilterArray(BaseTester):
    """Tags of DNG files of our own writer are changed one at a time."""

    @pytest.fixture
    def data(self):
        return encode_dng(RawCapture.from_counts(torch.from_numpy(COUNTS)[None], "RGGB", 64, 1023))

    @pytest.mark.parametrize("name", README)
    def test_smoke_nothing_is_wrong_with_cameras(self, name):
        sensor(shared(f"data/{name}").read_bytes())

    @pytest.mark.parametrize(
        ("tag", "changes", "sentence"),
        [
            (PATTERN, {"value": bytes([0, 1, 1, 7])}, "its CFAPattern holds 7, which is not among its colours 0 1 2"),
            (PATTERN, {"value": bytes([0, 3, 1, 9])}, "holds 3 9, which is not among its colours 0 1 2"),
            (PATTERN, {"value": bytes([255] * 4)}, "holds 255, which"),
            (PATTERN, {"number": 3}, "its CFAPattern has 3 entries, its CFARepeatPatternDim says 2 x 2"),
            (PATTERN, {"number": 0}, "its CFAPattern is missing or cannot be read"),
            (PATTERN, {"number": 2**31}, "its CFAPattern is missing"),
            (PATTERN, {"kind": 12}, "its CFAPattern is missing"),
            (PATTERN, {"tag": 33423}, "its CFAPattern is missing"),
            (PATTERN, {"number": 5000, "value": struct.pack("<I", 8)}, "its CFAPattern is missing|has 5000 entries"),
            (REPEAT, {"value": struct.pack("<HH", 2, 3)}, "has 4 entries, its CFARepeatPatternDim says 2 x 3"),
            (REPEAT, {"value": bytes(4)}, "its CFARepeatPatternDim is 0 0, not two numbers from 1 to 8"),
            (REPEAT, {"value": b"\xff" * 4}, "its CFARepeatPatternDim is 65535 65535, not two"),
            (REPEAT, {"number": 1}, "its CFARepeatPatternDim is 2, not two"),
            (REPEAT, {"tag": 33420}, "its CFARepeatPatternDim is empty, not two"),
            (COLORS, {"value": bytes([0, 1, 1, 0])}, "its CFAPlaneColor is 0 1 1, not different colours from 0 to 6"),
            (COLORS, {"value": bytes([0, 1, 9, 0])}, "its CFAPlaneColor is 0 1 9, not different"),
            (COLORS, {"number": 2}, "its CFAPattern holds 2, which is not among its colours 0 1"),
            (COLORS, {"number": 0}, "its CFAPlaneColor is empty"),
            (LAYOUT, {"value": struct.pack("<HH", 2, 0)}, "its CFALayout is 2, and only 1, pixels in rows and columns"),
        ],
    )
    def test_exception_names_what_contradicts(self, data, tag, changes, sentence):
        """LibRaw showed most of these as other arrays, colours from beyond its tables among them, or as monochrome."""
        changed = patched(data, tag, **changes)
        assert re.search(sentence, fault(changed))
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of \d+ bytes: [^\n]*({sentence})"):
            RawCapture.open(changed)

    def test_exception_said_twice_and_differently(self, data):
        """LibRaw believes the last one."""
        assert "its CFAPattern is missing" in fault(
            patched(data, LAYOUT, tag=PATTERN, kind=BYTE, number=4, value=bytes([7] * 4))
        )

    def test_exception_in_any_directory(self, data):
        """The second one is no picture, and LibRaw takes its pattern all the same."""
        second = struct.pack("<HHHIIHHI4sI", 2, REPEAT, SHORT, 2, 2 | 2 << 16, PATTERN, BYTE, 4, bytes([0, 1, 1, 7]), 0)
        linked = bytearray(data)
        end = 10 + 12 * struct.unpack_from("<H", data, 8)[0]
        struct.pack_into("<I", linked, end, len(data))
        assert "its CFAPattern holds 7" in fault(bytes(linked) + second)

    def test_feature_other_files_are_left_to_libraw(self, data):
        assert sensor(patched(patched(data, PATTERN, value=bytes([7] * 4)), 50706, tag=50700)) is None


class TestDngSensor(BaseTester):
    @pytest.mark.parametrize(
        ("extra", "sentence"),
        [
            ({259: (SHORT, [52546])}, r"its picture is compressed by JPEG XL \(Compression 52546\), not decoded here"),
            ({259: (SHORT, [34712])}, "its picture is compressed by the unknown method 34712"),
            ({258: (SHORT, [32])}, "its samples are integers of 32 bits, and those of 1 to 16 can be decoded"),
            ({258: (SHORT, [64]), 339: (SHORT, [3])}, "floating-point numbers of 64 bits, and those of 16, 24 or 32"),
            ({50975: (LONG, [2])}, r"its pixels are interleaved, which cannot be decoded \(RowInterleaveFactor 2"),
            ({339: (SHORT, [2])}, r"its SampleFormat is 2, not 1 \(unsigned\) or 3"),
            ({277: (SHORT, [2])}, "its picture behind a filter array has 2 samples a pixel, not 1"),
            ({257: (LONG, [10])}, "its picture has 48 x 10 pixels, and 22 to 64000 can be decoded"),
            ({50829: (LONG, [0, 0, 37, 48])}, "its ActiveArea 0 0 37 48 does not lie within its 48 x 36 pixels"),
            ({50829: (LONG, [4, 4, 20, 40])}, "its ActiveArea 4 4 20 40 is smaller than 22 x 22"),
            ({50713: (SHORT, [2, 2]), 50714: (LONG, [1, 2])}, "has 2 values, its BlackLevelRepeatDim says 2 x 2"),
            ({50714: (LONG, [1, 2, 3, 4])}, "its BlackLevel has 4 values, its BlackLevelRepeatDim says 1 x 1"),
            ({50714: (LONG, [1]), 50715: (LONG, [1] * 47)}, "its BlackLevelDeltaH has 47 values for an active area of"),
            ({50717: (LONG, [1023, 1000])}, "its WhiteLevel has 2 values for 1 samples a pixel"),
            ({50710: (BYTE, [0, 1, 2, 6])}, "its filter array has the colours B G R of the planes R G B W"),
        ],
    )
    def test_exception_names_the_property(self, extra, sentence):
        data = dng(COUNTS, extra=extra)
        assert re.search(sentence, fault(data))
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of \d+ bytes: [^\n]*({sentence})"):
            RawCapture.open(data)

    def test_exception_linear_planes_without_names(self):
        counts = np.random.default_rng(0).integers(64, 1000, (36, 48, 4))
        assert "has 4 samples a pixel and the colours R G B" in fault(dng(counts, None))

    def test_feature_missing_bytes(self):
        data = dng(COUNTS)
        assert missing(data) == 0
        assert missing(data[:-100]) == 100
        assert missing(dng(COUNTS, extra={254: (SHORT, [1])})[:-100]) == 0  # a preview may lie anywhere


class TestColours(BaseTester):
    def test_feature_four_colours_have_the_files_names(self):
        """White balance is relative to green, wherever it stands, and each colour keeps its row of the matrix."""
        neutral, matrix = {"R": 0.5, "G": 1.0, "B": 0.6, "W": 0.8}, np.random.default_rng(2).uniform(0.2, 1, (4, 3))
        rows = dict(zip("RGBW", matrix, strict=True))
        found = {}
        for names in ("RGBW", "WBGR"):
            extra = {COLORS: (BYTE, ["RGBCMYW".index(name) for name in names])}
            told = {"neutral": [neutral[n] for n in names], "matrix": np.ravel([rows[n] for n in names]).tolist()}
            raw = RawCapture.open(dng(COUNTS, "RGWB", extra=extra, **told))
            assert (raw.pattern_letters, raw.colors) == ("RGWB", names)
            self.assert_close(raw.white_balance, torch.tensor([1 / neutral[n] for n in names]))
            found[names] = raw, develop(raw, "bilinear", encoded=False)
        self.assert_close(found["RGBW"][1], found["WBGR"][1], rtol=1e-4, atol=1e-4)
        self.assert_close(
            found["RGBW"][0].camera_to_srgb, found["WBGR"][0].camera_to_srgb.flip(1), rtol=1e-4, atol=1e-4
        )

    @pytest.mark.parametrize("pattern", ["RGGB", XTRANS, None])
    def test_feature_three_colours_in_any_order_are_one_picture(self, pattern):
        neutral, matrix = {"R": 0.5, "G": 1.0, "B": 0.6}, np.random.default_rng(2).uniform(0.2, 1, (3, 3))
        rows, pictures = dict(zip("RGB", matrix, strict=True)), []
        for names in ("RGB", "BRG"):
            counts = COUNTS if pattern else np.stack([COUNTS // (2 + "RGB".index(n)) for n in names], -1)
            extra = {COLORS: (BYTE, ["RGB".index(name) for name in names])}
            told = {"neutral": [neutral[n] for n in names], "matrix": np.ravel([rows[n] for n in names]).tolist()}
            raw = RawCapture.open(dng(counts, pattern, extra=extra, **told))
            pictures.append(develop(raw, "bilinear", encoded=False))
        self.assert_close(*pictures, rtol=1e-5, atol=1e-5)

    def test_feature_white_balance_of_planes_with_different_white(self):
        """LibRaw multiplies it by their ranges, which the levels do already."""
        counts = np.random.default_rng(0).integers(64, 700, (36, 48, 3))
        one = RawCapture.open(dng(counts, None, black=(0,)))
        other = RawCapture.open(dng(counts, None, black=(0,), extra={50717: (LONG, [1023, 800, 1000])}))
        assert torch.equal(one.white_balance, other.white_balance)
        self.assert_close(one.daylight_balance, other.daylight_balance)


class TestSamples(BaseTester):
    @pytest.mark.parametrize("white", [1, 1000, 60000])
    def test_feature_floating_point_is_what_was_stored(self, white):
        """LibRaw made counts of it: of 14 bits, relative to the brightest pixel, without what is negative."""
        light = np.random.default_rng(0).normal(0.3, 4, (36, 48)).astype(np.float32)
        told = {258: (SHORT, [32]), 339: (SHORT, [3])}
        raw = RawCapture.open(dng(COUNTS, black=(0,), white=white, extra=told, blocks=[(light * white).tobytes()]))
        assert (raw.counts.dtype, raw.white) == (torch.float32, white)
        np.testing.assert_array_equal(raw.counts[0].numpy(), light * np.float32(white))
        assert raw.mosaic().max() > 8
        with pytest.raises(ValueError, match=r"counts must be whole numbers, got torch\.float32"):
            encode_dng(raw)

    @pytest.mark.parametrize("order", ["<", ">"])
    @pytest.mark.parametrize("tile", [None, (16, 32)])
    def test_feature_floating_point_below_a_preview_as_tifffile_writes_it(self, order, tile, tmp_path):
        light = np.random.default_rng(0).uniform(0, 9, (36, 48)).astype(np.float16)
        version = [(50706, "B", 4, (1, 4, 0, 0), True), (50708, "s", 0, "Maker Model One", True)]
        sensor_tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([1, 0, 2, 1]), True)]
        with tifffile.TiffWriter(tmp_path / "a.dng", byteorder=order) as file:
            preview = np.zeros((16, 16, 3), np.uint8)
            file.write(preview, photometric="rgb", subfiletype=1, subifds=1, extratags=version, metadata=None)
            stored = {"compression": "deflate", "predictor": 3, "tile": tile, "extratags": sensor_tags}
            file.write(light, photometric="cfa", subfiletype=0, metadata=None, **stored)
        raw = RawCapture.open(tmp_path / "a.dng")
        assert (raw.pattern_letters, raw.white) == ("GRBG", 1)
        np.testing.assert_array_equal(raw.counts[0].numpy(), light)

    def test_feature_white_of_floating_point_is_one_by_default(self):
        told = {258: (SHORT, [32]), 339: (SHORT, [3]), 50717: None}
        raw = RawCapture.open(dng(COUNTS, black=(0,), extra=told, blocks=[(COUNTS / 1024).astype("<f4").tobytes()]))
        assert raw.white == 1

    def test_feature_levels_of_fractions(self):
        raw = RawCapture.open(dng(COUNTS, extra={50714: (RATIONAL, [63.5])}))
        assert raw.black.tolist() == [[63.5, 63.5], [63.5, 63.5]]

    @pytest.mark.parametrize(
        ("extra", "sentence"),
        [
            ({259: (SHORT, [7]), 322: (LONG, [64]), 323: (LONG, [16])}, "its JPEG tiles of 64 pixels are wider"),
            ({259: (SHORT, [34892])}, "its lossy JPEG is not of the kind that can be linearised"),
            ({259: (SHORT, [8]), 317: (SHORT, [3])}, "its Predictor 3 does not belong to its integer samples of 16"),
            ({258: (SHORT, [8]), 322: (LONG, [0]), 323: (LONG, [16])}, "its tiles have 0 x 16 pixels"),
            ({278: (LONG, [5])}, "its picture takes 8 strips, and it names 1 places and 1 sizes"),
        ],
    )
    def test_exception_names_how_it_is_stored(self, extra, sentence):
        data = dng(COUNTS, extra=extra, tiles=322 in extra)
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of \d+ bytes: [^\n]*({sentence})"):
            RawCapture.open(data)

    def test_exception_damaged_deflate(self):
        told = {259: (SHORT, [8])}
        with pytest.raises(ValueError, match="it is damaged: its Deflate data cannot be decompressed"):
            RawCapture.open(dng(COUNTS, extra=told))


class TestOpcodes(BaseTester):
    def test_feature_what_is_not_applied_is_told_once(self):
        warp = struct.pack(">5I", 1, 1, 0x01030000, 0, 0)
        data = dng(COUNTS, extra={51009: (UNDEFINED, gain_map()), 51022: (UNDEFINED, warp)})
        with pytest.warns(UserWarning, match=r"its opcodes GainMap \(optional\), WarpRectilinear are not app") as told:
            raw = RawCapture.open(data)
        assert len(told) == 1
        assert raw.info.ignored_opcodes == ("GainMap (optional)", "WarpRectilinear")
        np.testing.assert_array_equal(raw.counts[0].numpy(), COUNTS)

    def test_feature_polynomials_of_lossy_jpeg_are_applied(self):
        data = shared("data/raw/photoprism+photoprism/canon_eos_6d.dng").read_bytes()
        found = sensor(data)
        assert found.directory.entries.get(51009)
        assert ignored_opcodes(data, found) == []

    @pytest.mark.parametrize("keep", [0, 3, 12, 19, 60])
    def test_feature_what_is_cut_short_is_left_out(self, keep):
        data = dng(COUNTS, extra={51009: (UNDEFINED, gain_map()[:keep].ljust(5, b"\xff"))})
        assert ignored_opcodes(data, sensor(data)) == []
