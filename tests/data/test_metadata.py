"""EXIF and texts, read back by Pillow, which had no part in writing them."""

from __future__ import annotations

import io
from datetime import datetime

import cv2
import numpy as np
import pytest

from kornia_tidy.data.metadata import with_exif, with_text
from kornia_tidy.lab.raw.tags import camera_tags
from tests.base import BaseTester

Image = pytest.importorskip("PIL.Image", reason="Pillow, which comes with matplotlib, is not installed")

INFO = {
    "make": "Canon",
    "model": "EOS Kiss X4",
    "lens": "EF-S 18-55mm",
    "exposure": 1 / 160,
    "aperture": 5.6,
    "iso": 200.0,
    "focal_length": 0.0425,
    "timestamp": datetime(2021, 5, 4, 3, 2, 1),
    "unheard_of": 3,
}
SUFFIXES = [".png", ".jpg", ".tif"]
every_format = pytest.mark.parametrize("suffix", SUFFIXES)


def encoded(suffix, dtype=np.uint8, shape=(9, 7, 3)):
    picture = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype)
    return cv2.imencode(suffix, picture)[1].tobytes()


def pixels(file):
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)


class TestWithExif(BaseTester):
    @every_format
    def test_feature_pillow_reads_it(self, suffix):
        exif = Image.open(io.BytesIO(with_exif(encoded(suffix), INFO))).getexif()
        photo = exif.get_ifd(0x8769)
        assert (exif[0x010F], exif[0x0110]) == ("Canon", "EOS Kiss X4")
        assert photo[0xA434] == "EF-S 18-55mm"
        assert photo[0x9003] == "2021:05:04 03:02:01"
        assert photo[0x8827] == 200
        assert (float(photo[0x829A]), float(photo[0x829D]), float(photo[0x920A])) == (1 / 160, 5.6, 42.5)
        assert photo[0x9000] == b"0232"

    @every_format
    def test_feature_the_picture_is_not_touched(self, suffix):
        file = encoded(suffix)
        assert np.array_equal(pixels(with_exif(file, INFO)), pixels(file))

    @pytest.mark.parametrize("suffix", [".png", ".tif"])
    @pytest.mark.parametrize("shape", [(40, 30, 3), (300, 301)])
    def test_feature_sixteen_bits_too(self, suffix, shape):
        file = encoded(suffix, np.uint16, shape)
        assert np.array_equal(pixels(with_exif(file, INFO)), pixels(file))

    def test_feature_our_own_reader_of_raw_files_agrees(self):
        found = camera_tags(with_exif(encoded(".tif"), INFO))
        for name in ("make", "model", "lens", "iso"):
            assert found[name] == INFO[name]
        for name in ("exposure", "aperture", "focal_length"):
            assert found[name] == pytest.approx(INFO[name], rel=1e-6)

    @every_format
    def test_feature_what_is_unknown_is_left_out(self, suffix):
        file = encoded(suffix)
        assert with_exif(file, {"make": None, "other": 3}) == file
        exif = Image.open(io.BytesIO(with_exif(file, {"make": "Å", "iso": 10**6}))).getexif()
        assert exif[0x010F] == "?"
        assert exif.get_ifd(0x8769)[0x8827] == 65535
        assert 0x0110 not in exif

    def test_exception_other_formats(self):
        with pytest.raises(ValueError, match="EXIF is written into PNG, JPEG and little-endian TIFF files"):
            with_exif(b"GIF89a", INFO)


class TestWithText(BaseTester):
    def test_feature_pillow_reads_it(self):
        file = with_text(encoded(".png"), {"depth_scale": "0.001", "Description": "metres = value * 0.001"})
        Image.open(io.BytesIO(file)).verify()  # checks every sum, and closes
        picture = Image.open(io.BytesIO(file))
        assert picture.text == {"depth_scale": "0.001", "Description": "metres = value * 0.001"}
        assert np.array_equal(pixels(file), pixels(encoded(".png")))
