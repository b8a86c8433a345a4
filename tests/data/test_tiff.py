from __future__ import annotations

import io
import re
import shutil
import struct
import subprocess
from collections import Counter

import cv2
import numpy as np
import pytest
from PIL import Image

from kornia_tidy.data import read_depth, read_image
from kornia_tidy.data.stored import Stored, decode_stored
from tests.base import BaseTester
from tests.data import tiff_walk
from tests.data.tiff_writer import Page, lzw, tiff

GENERATOR = np.random.default_rng(0)
Y, X = np.mgrid[:40, :60]
RGB = (np.stack([X * 4, Y * 6, X + Y], -1) + GENERATOR.integers(0, 9, (40, 60, 3))).astype(np.uint8)
GREY = RGB[..., :1]
DEPTH = Page(np.arange(1, 241).reshape(12, 20, 1), 16)


def decoded(data: bytes, **options: bool) -> Stored:
    return decode_stored(data, "a.tif", **options)


def by_pillow(picture: np.ndarray, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "tiff", **options)
    return file.getvalue()


def by_opencv(data: bytes) -> np.ndarray:
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return found[..., None] if found.ndim == 2 else found[..., ::-1]


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture)[1].tobytes()


def walked(count: int, seed: int, folder) -> Counter[str]:
    """Read combinations of properties; return how many were read and refused."""
    counts: Counter[str] = Counter()
    for number, case in enumerate(tiff_walk.cases(count, seed)):
        accepted, wrong = tiff_walk.read(case, folder / "a.tif", np.random.default_rng([seed, number]))
        assert not wrong
        counts["read" if accepted else "refused"] += 1
    return counts


class TestReadsWhatIsStored(BaseTester):
    def test_property_combinations_of_properties(self, tmp_path):
        counts = walked(150, 0, tmp_path)
        assert min(counts["read"], counts["refused"]) > 50

    @pytest.mark.parametrize(
        "compression", ["raw", "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate", "packbits", "jpeg"]
    )
    @pytest.mark.parametrize("picture", [RGB, GREY[..., 0]])
    def test_feature_equals_libtiff_bit_for_bit(self, compression, picture):
        """Written and decoded by two other programs' libtiff, Pillow's and OpenCV's."""
        data = by_pillow(picture, compression=compression)
        assert np.array_equal(decoded(data).values, by_opencv(data))

    @pytest.mark.parametrize(
        "options",
        ["-c jpeg:90", "-c jpeg:r -t -w 32 -l 16", "-c lzw:2 -p separate", "-c zip:2 -B", "-c zstd:2 -8 -r 7",
         "-c lzma:2 -t -w 16 -l 32", "-f lsb2msb -c packbits -B -8"],
    )  # fmt: skip
    def test_feature_what_libtiff_writes(self, options, tmp_path):
        """Every way of storing one picture gives the same numbers; those of JPEG equal OpenCV's."""
        if shutil.which("tiffcp") is None:
            pytest.skip("tiffcp of libtiff is not on this machine")
        (tmp_path / "a.tif").write_bytes(by_pillow(RGB))
        command = ["tiffcp", *options.split(), str(tmp_path / "a.tif"), str(tmp_path / "b.tif")]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip(f"this tiffcp does not write {options}")
        data = (tmp_path / "b.tif").read_bytes()
        assert np.array_equal(decoded(data).values, by_opencv(data) if "jpeg" in options else RGB)

    def test_feature_lzw_of_before_1992(self):
        """With the bits of codes the other way round."""
        coded = lzw(RGB.tobytes(), old=True)
        assert np.array_equal(decoded(tiff(Page(RGB, photometric=2, compression=5, segments=[coded]))).values, RGB)

    def test_feature_lengths_of_strips_that_are_not_given(self):
        page = Page(RGB, photometric=2, compression=8, fields={279: None})
        assert np.array_equal(decoded(tiff(page)).values, RGB)

    def test_feature_one_number_of_bits_for_all_samples(self):
        page = Page(RGB, photometric=2, fields={258: (3, [8]), 339: None})
        assert np.array_equal(decoded(tiff(page)).values, RGB)

    def test_feature_palette_of_bytes_in_the_lower_half(self):
        """As programs wrote it that took the field for bytes."""
        palette = GENERATOR.integers(0, 256, (256, 3))
        found = decoded(tiff(Page(GREY, photometric=3, fields={320: (3, palette.T.ravel().tolist())})))
        assert np.array_equal(found.values, palette[GREY[..., 0]])
        assert found.white == 255

    @pytest.mark.parametrize("orientation", range(11))
    def test_convention_orientation_is_reported_and_not_applied(self, orientation):
        found = decoded(tiff(Page(RGB, photometric=2, fields={274: (3, [orientation])})))
        assert np.array_equal(found.values, RGB)
        assert found.orientation == (orientation if 1 <= orientation <= 8 else 1)


class TestMissingValues(BaseTester):
    @pytest.mark.parametrize(
        ("bits", "kind", "text", "value"),
        [(32, 3, b"-3.4028234663852886e+38", np.finfo("f4").min), (32, 3, b"-3.40282346639e+38", np.finfo("f4").min),
         (32, 3, b"0.1", np.float32(0.1)), (32, 3, b"inf", np.inf), (16, 1, b"65535", 65535),
         (16, 1, b"65535.0", 65535),
         (16, 2, b"32767", 32767), (64, 1, b"9007199254740993", 2**53 + 1), (16, 3, b" 1e3\n", 1000),
         (32, 3, b"-1.#QNAN", np.nan)],
    )  # fmt: skip
    def test_feature_value_of_gdal(self, bits, kind, text, value, tmp_path):
        """Compared in the data type of the file, as GDAL does."""
        values = np.full((3, 4, 1), 7, f"{' uif'[kind]}{bits // 8}")
        values[1, 2], values[0, 0] = value, 2**53 if bits == 64 else 6
        (tmp_path / "a.tif").write_bytes(tiff(Page(values, bits, kind, fields={42113: (2, text + b"\0")})))
        valid = read_depth(tmp_path / "a.tif").valid[0].numpy()
        assert np.argwhere(~valid).tolist() == [[1, 2]]

    @pytest.mark.parametrize(
        ("tag", "text"),
        [(42112, b'<Item name="SCALE" sample="0" role="scale">0.001</Item>'),
         (42112, b"<Item name='UNITTYPE' sample='0' role='unittype'>mm</Item>"),
         (270, b"ImageJ=1.5\nimages=1\ncf=0\nc0=0\nc1=.1\nvunit=cm\n")],
    )  # fmt: skip
    def test_feature_the_unit_of_gdal_and_imagej_is_told(self, tag, text, tmp_path):
        (tmp_path / "a.tif").write_bytes(tiff(Page(DEPTH.values, 16, fields={tag: (2, text + b"\0")})))
        read_depth(tmp_path / "a.tif", 0.001)
        with pytest.warns(UserWarning, match=r"its numbers are to be multiplied by 0.001, and scale is 1"):
            read_depth(tmp_path / "a.tif")

    @pytest.mark.parametrize(
        ("tag", "text", "sentence"),
        [(42112, b'<Item name="OFFSET" sample="0" role="offset">-5</Item>', r"changed by offset -5 \(GDAL_METADATA\)"),
         (42112, b'<Item name="SCALE" sample="0" role="scale">x</Item>', "its GDAL_METADATA gives x, 0, not numbers"),
         (270, b"ImageJ=1.5\nimages=1\ncf=0\nc0=-32768.0\nc1=1.0\n",
          r"changed by cf 0, c0 -32768.0, c1 1.0 \(calibration"),
         (270, b"ImageJ=1.5\nimages=1\ncf=20\n", "changed by cf 20"),
         (42113, b"none", "its GDAL_NODATA is 'none', which is no number")],
    )  # fmt: skip
    def test_exception_numbers_that_are_to_be_changed(self, tag, text, sentence):
        with pytest.raises(ValueError, match=sentence):
            decoded(tiff(Page(DEPTH.values, 16, fields={tag: (2, text + b"\0")})), depth=True)


class TestRefused(BaseTester):
    """One sentence that names the property; "damaged" is for damaged files."""

    @pytest.mark.parametrize(
        ("page", "sentence"),
        [
            ({"fields": {258: (3, [8, 8, 16])}}, "its samples differ: bits are 8, 8, 16"),
            ({"fields": {339: (3, [1, 1, 3])}}, "its samples differ: SampleFormat are 1, 1, 3"),
            ({"fields": {32997: (4, [9])}}, r"it is a volume of 9 slices \(ImageDepth\)"),
            ({"fields": {270: (2, b"ImageJ=1.53t\nimages=12\nframes=12\n\0")}}, r"it holds 12 pictures \(pages\)"),
            ({"fields": {270: (2, b'{"shape": [7, 40, 60, 3], "truncated": true}\0')}}, "it holds 7 pictures"),
            ({"fields": {33629: (5, [1, 1] * 30)}}, "it holds 30 pictures"),  # MetaMorph
            ({"fields": {50706: (1, [1, 4, 0, 0])}}, r"it is a camera raw file \(DNG\): .* kornia-tidy raw develop"),
            ({"fields": {33422: (1, [0, 1, 1, 2])}}, "it is a camera raw file"),
            ({"photometric": 1, "fields": {338: (3, [2] * 999)}}, "3 samples a pixel .* and ExtraSamples 2, 2, 2"),
            ({"compression": 34712}, r"its compression is 34712 \(JPEG2000\), not read"),
            ({"fields": {262: (3, [5])}}, r"pixels is not read \(photometric interpretation 5, SEPARATED\)"),
            ({"fields": {262: (3, [6])}}, r"its pixels are YCbCr \(photometric interpretation 6\)"),
            ({"bits": 4, "format": 2}, r"its samples are 4-bit signed integers \(SampleFormat 2\), which are not read"),
            ({"bits": 16, "compression": 7}, "its compression is 7 with 16-bit unsigned integers"),
            ({"fields": {254: (4, [1])}}, r"only a reduced-resolution preview \(NewSubfileType 1\).* raw develop"),
            ({"fields": {254: (4, [4])}}, r"only a transparency mask \(NewSubfileType 4\)"),
        ],
    )
    def test_exception_intact_files_of_kinds_that_are_not_read(self, page, sentence):
        with pytest.raises(ValueError, match=sentence) as caught:
            decoded(tiff(Page(RGB, **{"photometric": 2} | page)))
        assert "damaged" not in str(caught.value)

    @pytest.mark.parametrize("mark", [None, (4, [0]), (4, [1])])
    def test_exception_a_picture_below_its_preview(self, mark):
        """Marked as a preview or not."""
        raw, small = Page(RGB[..., :1], photometric=32803), RGB[::4, ::4]
        with pytest.raises(ValueError, match=r"it is a camera raw file .* kornia-tidy raw develop"):
            decoded(tiff(Page(small, photometric=2, fields={254: mark}, below=[raw])))
        picture = tiff(Page(small, photometric=2, fields={254: mark}, below=[Page(RGB, photometric=2)]))
        if mark == (4, [1]):
            assert np.array_equal(decoded(picture).values, RGB)
            return
        with pytest.raises(ValueError, match=r"it holds 2 pictures \(pages\)"):
            decoded(picture)
        damaged = Page(RGB, photometric=2, fields={254: mark, 330: (4, [10**6])})
        assert np.array_equal(decoded(tiff(damaged)).values, RGB)

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            ({"fields": {273: (4, [10**6])}}, "the file is cut short: a strip reaches beyond its end"),
            ({"fields": {279: (4, [100])}}, "strip 1 of 1 has 100 bytes, too few"),
            ({"fields": {278: (4, [0])}}, "damaged: its strips or tiles have 0 x 60 pixels"),
            ({"fields": {278: (4, [1])}}, "damaged: it has 40 strips, and 1 offsets"),
            ({"fields": {257: (4, [0])}}, "damaged: it has 0 x 60 pixels"),
            ({"fields": {256: (11, [60.0])}}, "damaged: field 256 holds no whole numbers"),
            ({"fields": {266: (3, [7])}}, "damaged: its FillOrder is 7"),
            ({"fields": {262: (3, [3]), 277: (3, [1])}}, "damaged: its palette has 0 numbers, not 768"),
            ({"fields": {277: (3, [1])}}, "damaged: it is RGB with 1 samples a pixel"),
            ({"compression": 8, "segments": [b"\x78\x9c" + bytes(500)]}, r"damaged: strip 1 of 1 \("),
            ({"compression": 5, "segments": [lzw(bytes(99)) + bytes(60)]}, r"damaged: strip 1 of 1 \("),
            ({"compression": 7, "segments": [jpeg(RGB[:32])]}, "damaged: strip 1 of 1 is a JPEG of 32 x 60 pixels"),
            ({"compression": 7, "segments": [jpeg(RGB)[:-40]]}, "cut short or damaged: strip 1 of 1 is no whole"),
            ({"rows_per_strip": 20, "fields": {273: (4, [8, 8]), 279: (4, [5000] * 2)}, "compression": 8,
              "segments": [bytes(4000)] * 2},
             "damaged: its strips lie over each other"),
        ],
    )  # fmt: skip
    def test_exception_damaged_files(self, damage, sentence):
        with pytest.raises(ValueError, match=sentence):
            decoded(tiff(Page(RGB, photometric=2, **damage)))

    def test_exception_directories_in_a_circle_and_without_end(self):
        data = bytearray(tiff(DEPTH))
        data[-4:] = data[4:8]
        with pytest.raises(ValueError, match="follow each other in a circle"):
            decoded(bytes(data))
        entry = struct.pack("<HHII", 256, 3, 1, 60)
        chain = b"".join(struct.pack("<H", 1) + entry + struct.pack("<I", 8 + 18 * n) for n in range(1, 2000))
        with pytest.raises(ValueError, match="it holds more than 1000 pages"):
            decoded(b"II*\0" + struct.pack("<I", 8) + chain)

    @pytest.mark.parametrize("big", [False, True])
    def test_exception_any_cut_is_one_sentence(self, big):
        data = tiff(Page(RGB, photometric=2, compression=5, rows_per_strip=7), big=big)
        for kept in range(4, len(data), max(1, len(data) // 40)):
            with pytest.raises(ValueError, match=r"cannot read a\.tif: the file is cut short[^\n]*$"):
                decoded(data[:kept])

    def test_exception_too_many_pixels(self):
        for tiles, fields in (
            ("", {256: (4, [10**6]), 257: (4, [10**6])}),
            ("", {257: (16, [2**63])}),
            (" in whole tiles", {322: (4, [10**6]), 323: (4, [10**6])}),
        ):
            with pytest.raises(ValueError, match=rf"the picture{tiles} has \d+ x \d+ pixels, more than 268435456: set"):
                decoded(tiff(Page(RGB, photometric=2, tile=(16, 16), fields=fields), big=True))

    def test_feature_a_stack_is_no_depth_of_its_first_page(self, tmp_path):
        """OpenCV, Pillow and others read the first page without a word."""
        (tmp_path / "a.tif").write_bytes(tiff(DEPTH, DEPTH, DEPTH))
        for read in (read_image, read_depth):
            with pytest.raises(ValueError, match=re.escape("a.tif: it holds 3 pictures (pages): save the one that is")):
                read(tmp_path / "a.tif")
