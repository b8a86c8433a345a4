"""Files that claim what is not there: refused by their headers, before any memory is taken."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from kornia_tidy.data import image_files, read_image
from kornia_tidy.data.picture_header import VARIABLE, check_header, check_pixels
from tests.base import BaseTester

SUFFIXES = (".png", ".jpg", ".bmp", ".webp")
GREY = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


def encoded(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, GREY, list(options))[1].tobytes()


def png_of(rows: int, columns: int, packed: bytes) -> bytes:
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)), (b"IDAT", packed), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


class TestCheckHeader(BaseTester):
    @pytest.mark.parametrize(
        ("suffix", "options"),
        [
            (".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
            (".jpg", (cv2.IMWRITE_JPEG_RST_INTERVAL, 1)),
            (".webp", (cv2.IMWRITE_WEBP_QUALITY, 50)),
        ],
    )
    def test_feature_variants_pass(self, suffix, options):
        check_header(encoded(suffix, *options))

    @pytest.mark.parametrize("suffix", SUFFIXES)
    def test_exception_any_cut_is_one_sentence(self, suffix, tmp_path, capfd):
        data, path = encoded(suffix), tmp_path / "a"
        for kept in range(1, len(data) - 1, len(data) // 20):
            path.write_bytes(data[:kept])
            with pytest.raises(ValueError, match=r"cannot read .*a: [^\n]+$"):
                read_image(path)
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("suffix", [".gif", ".jp2", ".hdr"])
    def test_exception_formats_whose_size_is_not_looked_at(self, suffix):
        with pytest.raises(ValueError, match="not an image in a known format: PNG, JPEG, TIFF"):
            check_header(encoded(suffix))

    def test_exception_a_jpeg_that_ends_before_its_time(self, tmp_path, capfd):
        """Decoders fill the rest with grey; only libjpeg's warning, which is printed by C, tells of it."""
        data = encoded(".jpg")
        (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2] + b"\xff\xd9")
        with pytest.raises(ValueError, match=r"a\.jpg: the file is cut short or damaged \(Corrupt JPEG data"):
            read_image(tmp_path / "a.jpg")
        assert capfd.readouterr().err == ""

    def test_exception_a_png_with_too_few_lines(self, tmp_path, capfd):
        (tmp_path / "a.png").write_bytes(png_of(40, 60, zlib.compress(bytes(61 * 20))))
        with pytest.raises(ValueError, match=r"a\.png: .*damaged"):
            read_image(tmp_path / "a.png")
        assert capfd.readouterr().err == ""

    def test_exception_a_png_with_a_wrong_check_sum(self):
        data = bytearray(encoded(".png"))
        data[len(data) // 2] ^= 1
        with pytest.raises(ValueError, match="a check sum in it is wrong"):
            check_header(bytes(data))


class TestCheckPixels(BaseTester):
    def test_feature_the_limit_can_be_raised_and_lowered(self, monkeypatch):
        check_pixels("the scene", 1 << 14, 1 << 14)
        with pytest.raises(ValueError, match="the scene has 16384 x 16385 pixels, more than 268435456"):
            check_pixels("the scene", 1 << 14, (1 << 14) + 1)
        monkeypatch.setenv(VARIABLE, "100")
        with pytest.raises(ValueError, match="10 x 11 pixels, more than 100"):
            check_pixels("the scene", 10, 11)
        monkeypatch.setenv(VARIABLE, "1e6")
        with pytest.raises(ValueError, match="KORNIA_TIDY_MAX_PIXELS must be a whole number of pixels, got '1e6'"):
            check_pixels("the scene", 10, 11)
        monkeypatch.setenv(VARIABLE, str(1 << 40))
        check_pixels("the scene", 10**6, 10**6)

    def test_exception_floats_that_do_not_fit_the_memory(self, tmp_path, monkeypatch):
        """The stored pixels may, and the four times larger floats not."""

        def full(*_):
            raise MemoryError

        (tmp_path / "a.png").write_bytes(png_of(2, 2, zlib.compress(bytes(6))))
        assert read_image(tmp_path / "a.png").shape[1:] == (2, 2)
        monkeypatch.setattr(image_files, "_scaled", full)
        with pytest.raises(ValueError, match=r"a\.png: it needs more memory than there is"):
            read_image(tmp_path / "a.png")
