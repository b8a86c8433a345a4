from __future__ import annotations

import io
import json
import subprocess
import sys
from datetime import datetime

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.filter_array import filter_tile, tile_planes
from tests.base import DATA, BaseTester, shared
from tests.lab.raw.dng import XTRANS, dng

# As the README of the data says: filter array, black, white, rows, columns.
README = {
    "raw/thorsted+digicam_corpus/G2_CRW_0305.CRW": ("RGGB", 32, 1023, 1720, 2312),
    "raw/thorsted+digicam_corpus/DC120_P003908.KDC": ("GRBG", 0, 255, 976, 848),
    "raw/syoyo+tinydng/colorchart.dng": ("RGGB", 2056, 15000, 1156, 1734),
    "raw/haraldk+TwelveMonkeys/dng_test.dng": ("GBRG", 256, 51080, 1112, 1952),
    "raw/haraldk+TwelveMonkeys/crw_RAW_CANON_G1.CRW": ("GMYC", 31, 1023, 1550, 2088),
    "raw/imageio+test_images/Blackmagic.dng": ("RGGB", 512, 65535, 2176, 4128),
    "raw/photoprism+photoprism/canon_eos_6d.dng": (None, 0, 65535, 816, 1224),
    "raw/colinleroy+a2tools/QKTK_IMAGE01.QTK": ("GRBG", 0, 1023, 240, 320),
    "raw/colinleroy+a2tools/QKTK_Image__1.qtk": ("GRBG", 0, 1023, 480, 640),
    "raw/colinleroy+a2tools/DC50_DC0008L.KDC": ("GRBG", 0, 16383, 512, 768),
    "raw_synthetic/motorcycle_rggb.dng": ("RGGB", 512, 16383, 480, 720),
    "raw_synthetic/motorcycle_bggr.dng": ("BGGR", 512, 16383, 480, 720),
    "raw_synthetic/motorcycle_grbg.dng": ("GRBG", 512, 16383, 480, 720),
    "raw_synthetic/motorcycle_gbrg.dng": ("GBRG", 512, 16383, 480, 720),
    "raw_synthetic/motorcycle_linear.dng": (None, 512, 16383, 480, 720),
    "raw_synthetic/motorcycle_mono.dng": (None, 512, 16383, 480, 720),
    "raw_synthetic/aloe_xtrans.dng": ("GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG", 512, 16383, 1104, 1278),
}
REFUSED = (
    "drewnoakes+metadata-extractor-images",
    "exiftool+exiftool",
    "serptools+testdata",
    "sindresorhus+file-type",
    "mushfiqulalam+isp",
    "cruxopen+openISP",
)

BY_RAWPY = """
import json, sys
import rawpy
for path in json.loads(sys.argv[1]):
    with rawpy.imread(path) as raw:
        counts = raw.raw_image_visible.copy()
        colors = None if counts.ndim == 3 else raw.raw_colors_visible[:6, :6].tolist()
        head = [counts.shape, colors, raw.color_desc.decode(), raw.black_level_per_channel, raw.white_level]
    sys.stdout.buffer.write(json.dumps(head).encode() + b"\\n" + counts.tobytes())
"""


def a_third(names):
    """Every third name, and the others for tests that may take seconds."""
    return [pytest.param(name, marks=[pytest.mark.takes_seconds] * (n % 3 > 0)) for n, name in enumerate(names)]


def random_counts(height=36, width=48, *channels):
    return np.random.default_rng(0).integers(64, 1000, (height, width, *channels))


@pytest.fixture(scope="module")
def by_rawpy():
    """Counts and levels as rawpy itself gives them, in a process without our code: the oracle."""
    names = [name for name in README if (DATA / name).is_file()]
    paths = [str(DATA / name) for name in names]
    told = subprocess.run([sys.executable, "-c", BY_RAWPY, json.dumps(paths)], capture_output=True, check=True)
    stream, found = io.BytesIO(told.stdout), {}
    for name in names:
        shape, colors, letters, black, white = json.loads(stream.readline())
        counts = np.frombuffer(stream.read(2 * int(np.prod(shape))), np.uint16).reshape(shape)
        found[name] = counts, colors, letters, black, white
    return found


class TestOpenReal(BaseTester):
    @pytest.mark.parametrize("name", README)
    def test_feature_a_cameras_file(self, name, by_rawpy):
        """Size, pattern and levels are the README's; counts and planes are rawpy's, exactly."""
        raw = RawCapture.open(shared(f"data/{name}"))
        letters, black, white, height, width = README[name]
        counts, colors, desc, levels, white_level = by_rawpy[name]
        assert raw.pattern_letters == letters
        assert tuple(raw.counts.shape[1:]) == (height, width) == counts.shape[:2]
        assert raw.white == white == white_level
        assert set(raw.black.flatten().tolist()) == {black} == {float(levels[0])}
        expected = counts[None] if counts.ndim == 2 else counts.transpose(2, 0, 1)[:3]
        np.testing.assert_array_equal(raw.counts.numpy(), expected)
        if raw.pattern is None:
            return
        (rows, columns), light = raw.tile, raw.planes()
        for place, plane in enumerate(tile_planes(raw.counts, raw.tile).numpy()):
            row, column = divmod(place, columns)
            expected = counts[row : height // rows * rows : rows, column : width // columns * columns : columns]
            np.testing.assert_array_equal(plane, expected)
            assert desc[colors[row][column]] == letters[place]
            level = levels[colors[row][column]]
            exact = (expected - np.float64(level)) / (white - level)
            np.testing.assert_allclose(light[place].numpy(), exact, rtol=0, atol=1e-7)

    @pytest.mark.parametrize("name", a_third(sorted(str(p) for f in REFUSED for p in (DATA / "raw" / f).glob("*"))))
    def test_exception_refuses_with_one_sentence(self, name):
        with pytest.raises(ValueError, match=r"^cannot read .*: [^\n]+$"):
            RawCapture.open(name)

    def test_feature_colours_of_four(self):
        raw = RawCapture.open(shared("data/raw/haraldk+TwelveMonkeys/crw_RAW_CANON_G1.CRW"))
        assert raw.colors == "GMCY"
        assert raw.xyz_to_camera.shape == (4, 3)
        self.assert_close(raw.white_balance, torch.tensor([1307, 1274, 838, 857]) / 1307)


class TestOpen(BaseTester):
    def test_smoke_path_bytes_and_file(self, tmp_path):
        counts = random_counts()
        data = dng(counts)
        path = tmp_path / "shot.dng"
        path.write_bytes(data)
        with path.open("rb") as file:
            sources = [path, str(path), data, bytearray(data), memoryview(data), io.BytesIO(data), file]
            captures = [RawCapture.open(source) for source in sources]
        for raw in captures:
            np.testing.assert_array_equal(raw.counts[0].numpy(), counts)

    @pytest.mark.parametrize("order", ["<", ">"])
    def test_feature_all_that_a_file_says(self, order):
        raw = RawCapture.open(dng(random_counts(), order=order))
        info = raw.info
        assert (info.make, info.model, info.lens, info.iso) == ("Maker", "Model One", "Prime 35", 400)
        assert (info.exposure, info.aperture, info.focal_length) == (0.04, 2.8, 0.035)
        assert info.timestamp == datetime(2024, 2, 29, 12, 34, 56)
        assert (raw.white, raw.flip, raw.pixel_aspect, raw.xyz_to_camera) == (1023, 0, 1, None)
        self.assert_close(raw.white_balance, torch.tensor([2, 1, 1.6, 1]))
        self.assert_close(raw.camera_to_srgb.sum(1), torch.ones(3))  # camera white is white

    def test_feature_levels_of_each_place(self):
        raw = RawCapture.open(dng(random_counts(), "GRBG", black=(10, 20, 30, 40), black_repeat=(2, 2)))
        assert raw.black.tolist() == [[10, 20], [30, 40]]
        raw = RawCapture.open(dng(random_counts(), XTRANS, black=range(36), black_repeat=(6, 6)))
        assert raw.pattern_letters == XTRANS
        assert raw.black.flatten().tolist() == list(range(36))

    def test_feature_levels_that_repeat_more_slowly_than_the_filters(self):
        """LibRaw's package gives the smallest of them, 0, for every place."""
        counts, levels = random_counts(), np.tile(np.arange(16).reshape(4, 4), (9, 12))
        raw = RawCapture.open(dng(counts, black=range(16), black_repeat=(4, 4)))
        assert raw.black.tolist() == [[0, 1], [4, 5]]
        expected = (counts - levels) / (1023 - levels)
        np.testing.assert_allclose(raw.mosaic()[0].numpy(), expected, rtol=0, atol=0.5 / 1000)

    def test_feature_pattern_begins_at_the_visible_corner(self):
        """Counts say which filter they lie behind, by the active area's corner; LibRaw moves odd borders in."""
        at = np.roll(np.tile([[0, 1], [1, 2]], (18, 24)), (1, 3), (0, 1))
        counts = 100 + 300 * at + np.random.default_rng(1).integers(0, 50, at.shape)
        raw = RawCapture.open(dng(counts, "RGGB", active_area=(1, 3, 31, 44)))
        height, width = raw.counts.shape[1:]
        assert height >= 29
        assert width >= 40
        np.testing.assert_array_equal(raw.counts[0].numpy(), counts[31 - height : 31, 44 - width : 44])
        for letter, plane in zip(raw.pattern_letters, tile_planes(raw.counts, raw.tile), strict=True):
            assert ((plane - 100) // 300 == "RGB".index(letter)).all()

    @pytest.mark.parametrize(
        ("orientation", "expected"),
        [
            (0, lambda x: x),  # unknown
            (255, lambda x: x),
            (1, lambda x: x),
            (2, np.fliplr),
            (3, lambda x: np.rot90(x, 2)),
            (4, np.flipud),
            (5, np.transpose),
            (6, lambda x: np.rot90(x, -1)),
            (7, lambda x: np.rot90(x, 2).T),
            (8, np.rot90),
        ],
    )
    def test_feature_upright(self, orientation, expected):
        """Against the meaning of Exif's orientations, by NumPy."""
        counts = random_counts()
        raw = RawCapture.open(dng(counts, orientation=orientation))
        np.testing.assert_array_equal(raw.upright(raw.counts)[0].numpy(), expected(counts))

    def test_feature_linear_and_monochrome(self):
        counts = random_counts(36, 48, 3)
        raw = RawCapture.open(dng(counts, None, black=(10, 20, 30)))
        np.testing.assert_array_equal(raw.counts.numpy(), counts.transpose(2, 0, 1))
        assert (raw.pattern, raw.colors, raw.tile) == (None, "RGB", (1, 1))
        assert raw.black.tolist() == [10, 20, 30]
        raw = RawCapture.open(dng(counts[..., 0], None))
        assert (raw.pattern, raw.colors, raw.counts.shape) == (None, "", (1, 36, 48))
        self.assert_close(raw.planes(), raw.mosaic())

    def test_feature_one_black_level_of_three_channels(self):
        """LibRaw then takes it off the white level, and not off the counts: 959 instead of 1023."""
        counts = random_counts(36, 48, 3)
        one, three = (RawCapture.open(dng(counts, None, black=(64,) * number)) for number in (1, 3))
        assert one.black.tolist() == three.black.tolist() == [64, 64, 64]
        assert one.white == three.white == 1023
        assert torch.equal(one.mosaic(), three.mosaic())

    @pytest.mark.parametrize(("white", "most"), [(255, 54998), (500, 999)])
    def test_feature_a_white_level_that_lies_gives_way_to_the_counts(self, white, most):
        counts = np.random.default_rng(0).integers(64, most + 1, (36, 48))
        counts[0, 0] = most
        told = f"its white level {white} is wrong, as its counts reach {most}, which is taken for white: .*--white N"
        with pytest.warns(UserWarning, match=told) as caught:
            raw = RawCapture.open(dng(counts, white=white))
        assert len(caught) == 1
        assert raw.white == most
        assert raw.mosaic().max() == 1

    def test_feature_white_that_is_given_counts(self):
        raw = RawCapture.open(dng(random_counts(), white=500), white=999)
        assert raw.white == 999
        assert RawCapture.open(dng(random_counts(), white=64), white=1023).white == 1023
        with pytest.warns(UserWarning, match="of the counts lie above the white level 500, up to 999: it may be wrong"):
            assert RawCapture.open(dng(random_counts()), white=500).white == 500

    def test_feature_hot_pixels_are_no_white_level(self):
        counts = random_counts(100, 100)
        counts[:3, :3] = 60000
        assert RawCapture.open(dng(counts)).white == 1023

    @pytest.mark.parametrize(("white", "reason"), [(0, "white must be positive"), (64, "not above its black level 64")])
    def test_exception_white_that_makes_no_sense(self, white, reason):
        with pytest.raises(ValueError, match=reason):
            RawCapture.open(dng(random_counts()), white=white)

    @pytest.mark.parametrize(
        ("data", "reason"),
        [
            (b"", "the file is empty"),
            (b"text with a raw extension", "does not begin as raw files do"),
            (b"\xff\xd8\xff\xe1 and so on", "is a JPEG or PNG picture"),
            (b"II*\0" + bytes(100), "damaged|no raw file"),
            (dng(random_counts())[:-1], "cut short, 1 bytes of its picture"),
            (dng(np.full((36, 48), 64)), "all its 48 x 36 counts are 64"),
            (dng(random_counts(), white=64), "white level 64 is not above its black level 64"),
            (dng(random_counts(), black=(1010,)), "counts are below its black level 1010"),
            (dng(random_counts(), "RGRGR" * 4 + "GBGBG"), "its filter array repeats after 5 x 5 pixels"),
        ],
    )
    def test_exception_says_why(self, data, reason):
        with pytest.raises(ValueError, match=rf"^cannot read the raw file of {len(data)} bytes: .*({reason})"):
            RawCapture.open(data)

    def test_exception_of_paths(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="there is no such file"):
            RawCapture.open(tmp_path / "none.dng")
        with pytest.raises(ValueError, match="it is a folder"):
            RawCapture.open(tmp_path)
        with pytest.raises(ValueError, match="not a regular file"):
            RawCapture.open("/dev/zero")

    @pytest.mark.parametrize(("source", "got"), [(io.StringIO("text"), "a file of str"), (None, "NoneType")])
    def test_exception_of_other_sources(self, source, got):
        with pytest.raises(TypeError, match=f"binary file, got {got}"):
            RawCapture.open(source)


class TestOpenDump(BaseTester):
    @pytest.mark.parametrize("kind", ["uint8", "uint16"])
    @pytest.mark.parametrize("byte_order", ["little", "big"])
    def test_feature_counts_as_numpy_wrote_them(self, kind, byte_order):
        counts = np.random.default_rng(0).integers(0, 200, (6, 8))
        data = counts.astype(np.dtype(kind).newbyteorder(byte_order)).tobytes()
        raw = RawCapture.open_dump(data, (6, 8), "GBRG", (1, 2, 3, 4), 200, kind, byte_order)
        np.testing.assert_array_equal(raw.counts[0].numpy(), counts)
        assert raw.black.tolist() == [[1, 2], [3, 4]]
        assert raw.pattern_letters == "GBRG"

    @pytest.mark.parametrize(
        ("changed", "reason"),
        [
            ({"size": (6, 9)}, "9 x 6 counts of uint8 take 54 bytes, it has 48"),
            ({"size": (-6, -8)}, "it has 48"),
            ({"dtype": "int8"}, "dtype must be one of 'uint8', 'uint16', got 'int8'"),
            ({"byte_order": "native"}, "byte_order must be one of"),
            ({"white": 256}, "white must be at most 255"),
            ({"black": 100, "white": 100}, "white must be above black"),
            ({"black": (1, 2, 3)}, "black must be one level or 4, got 3"),
            ({"pattern": "RGB"}, "4 or 36 letters, got 'RGB'"),
            ({"pattern": "RGXB"}, "the letters of a filter array"),
        ],
    )
    def test_exception_says_what_does_not_fit(self, changed, reason):
        given_ = {"size": (6, 8), "pattern": "RGGB", "black": 0, "white": 255, "dtype": "uint8", **changed}
        with pytest.raises(ValueError, match=reason):
            RawCapture.open_dump(bytes(range(48)), **given_)


class TestRawCapture(BaseTester):
    @given(
        letters=st.sampled_from(["RGGB", "BGGR", "GRBG", "GBRG", "GMYC", XTRANS]),
        height=st.integers(6, 20),
        width=st.integers(6, 20),
    )
    @settings(max_examples=40)
    def test_feature_planes_hold_every_count_of_whole_tiles(self, letters, height, width):
        side = int(len(letters) ** 0.5)
        generator = np.random.default_rng(height * width)
        counts, black = generator.integers(0, 4096, (height, width)), generator.integers(0, 64, (side, side))
        raw = RawCapture.from_counts(torch.from_numpy(counts[None]), letters, black.ravel().tolist(), 4095)
        for place, plane in enumerate(raw.planes()):
            row, column = divmod(place, side)
            whole = counts[: height // side * side, : width // side * side][row::side, column::side]
            expected = (whole - black[row, column]) / (4095 - black[row, column])
            np.testing.assert_allclose(plane.numpy(), expected, rtol=0, atol=1e-7)
        assert raw.mosaic().shape == (1, height, width)

    def test_feature_the_green_of_blues_row_is_the_fourth_channel(self):
        """The order of dcraw: its documented codes of the four arrays."""
        assert filter_tile("RGGB") == (((0, 1), (3, 2)), "RGBG")
        assert filter_tile("BGGR") == (((2, 3), (1, 0)), "RGBG")
        assert filter_tile("GBRG") == (((3, 2), (0, 1)), "RGBG")
        assert filter_tile("GMYC") == (((0, 1), (3, 2)), "GMCY")
        assert filter_tile(XTRANS)[1] == "RGB"

    @pytest.mark.parametrize("shape", [(2, 4, 4), (4, 4), (1, 1, 4, 4)])
    def test_exception_shape(self, shape):
        with pytest.raises(ValueError, match="counts must have shape"):
            RawCapture.from_counts(torch.zeros(shape, dtype=torch.int32), None, 0, 1)

    def test_exception_linear_rgb_has_no_filter_array(self):
        with pytest.raises(ValueError, match="must have one channel, got 3"):
            RawCapture.from_counts(torch.zeros(3, 4, 4), "RGGB", 0, 1)
