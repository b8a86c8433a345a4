"""Kinds of PNG, JPEG, BMP and WebP: read to the number, or refused by name; 'damaged' is for damaged files."""

from __future__ import annotations

import io
import itertools
import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from kornia_tidy.data import read_depth, read_image
from kornia_tidy.data.image_files import read_linear
from kornia_tidy.data.picture_header import OTHERS, RAW
from tests.base import BaseTester

ROWS, COLUMNS = 5, 9
PALETTE = np.random.default_rng(3).integers(0, 256, (256, 3), dtype=np.uint8)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(values, bits, kind, *chunks):
    """A PNG of samples (H, W, C), of a colour type and with more chunks before the pixels."""
    rows, columns, channels = values.shape
    if bits == 16:
        lines = values.astype(">u2").tobytes()
        packed = [lines[2 * columns * channels * row :][: 2 * columns * channels] for row in range(rows)]
    else:
        digits = np.unpackbits(values.astype(np.uint8)[..., None], axis=-1)[..., 8 - bits :].reshape(rows, -1)
        packed = [line.tobytes() for line in np.packbits(digits, axis=1)]
    pixels = zlib.compress(b"".join(b"\0" + line for line in packed))
    head = struct.pack(">IIBBBBB", columns, rows, bits, kind, 0, 0, 0)
    parts = ((b"IHDR", head), *chunks, (b"IDAT", pixels), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(itertools.starmap(chunk, parts))


def bmp(bits, coding, pixels, palette=b"", masks=b""):
    """A BMP of 4 x 2 pixels with the header of Windows 3."""
    place = 54 + len(masks) + len(palette)
    info = struct.pack("<IiiHHIIiiII", 40, 4, 2, 1, bits, coding, len(pixels), 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", place + len(pixels), 0, 0, place) + info + masks + palette + pixels


def animated(kind):
    file = io.BytesIO()
    first, *others = (Image.new("RGB", (8, 8), (20 * number, 9, 9)) for number in range(3))
    first.save(file, kind, save_all=True, append_images=others)
    return file.getvalue()


def jpeg(mode="RGB", **options):
    file = io.BytesIO()
    Image.effect_noise((32, 24), 50).convert(mode).save(file, "JPEG", **options)
    return file.getvalue()


def jpeg_with(marker, bits=8):
    data = jpeg()
    place = data.index(b"\xff\xc0")
    return data[: place + 1] + bytes((marker,)) + data[place + 2 : place + 4] + bytes((bits,)) + data[place + 5 :]


def chunks(*more):
    return png(np.full((ROWS, COLUMNS, 3), 99), 8, 2, *more)


def profiled(kind, curve):
    """A file with an ICC profile of one tone curve, which Pillow embeds without looking at it."""
    profile = bytes(128) + struct.pack(">I4sII", 1, b"gTRC", 144, len(curve)) + curve
    file = io.BytesIO()
    Image.new("RGB", (COLUMNS, ROWS), (99, 99, 99)).save(file, kind, icc_profile=profile)
    return file.getvalue()


CURVES = [  # one identity in five forms, and sRGB
    b"curv" + bytes(4) + struct.pack(">IHH", 2, 0, 65535),
    b"curv" + bytes(8),
    b"curv" + bytes(4) + struct.pack(">IH", 1, 256),
    b"curv" + bytes(4) + struct.pack(">I256H", 256, *range(0, 65536, 257)),
    b"para" + bytes(4) + struct.pack(">HHi", 0, 0, 1 << 16),
    b"para" + bytes(4) + struct.pack(">HH5i", 3, 0, 157286, 62119, 3417, 5072, 2651),
]
FORMATS = ("PNG", "TIFF", "JPEG", "WEBP")
GAMMA = b"gAMA", struct.pack(">I", 100_000)
GREY = b"".join(bytes((level, level, level, 0)) for level in range(256))
REFUSED = {
    "animated PNG": (lambda: animated("PNG"), "it is an animated PNG"),
    "animated WebP": (lambda: animated("WEBP"), "it is an animated WebP"),
    "CMYK JPEG": (lambda: jpeg("CMYK"), "a JPEG of 4 components, such as CMYK"),
    "12-bit JPEG": (lambda: jpeg_with(0xC1, 12), "a JPEG of 12 bits a sample"),
    "lossless JPEG": (lambda: jpeg_with(0xC3), r"lossless or hierarchical JPEG \(SOF3\)"),
    "hierarchical JPEG": (lambda: jpeg_with(0xC5), r"lossless or hierarchical JPEG \(SOF5\)"),
    "16-bit BMP": (lambda: bmp(16, 0, bytes(16)), "a BMP of 16 bits a pixel with compression 0"),
    "565 BMP": (lambda: bmp(16, 3, bytes(16), b"", struct.pack("<III", 0xF800, 0x7E0, 0x1F)), "a BMP of 16 bits"),
    "JPEG in BMP": (lambda: bmp(24, 4, jpeg()), "a BMP of 24 bits a pixel with compression 4"),
    "10-bit BMP": (
        lambda: bmp(32, 3, bytes(32), b"", struct.pack("<III", 0x3FF00000, 0xFFC00, 0x3FF)),
        "in other bits",
    ),
}


class TestPictureKinds(BaseTester):
    @pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
    @pytest.mark.parametrize("more", [(), ((b"gAMA", struct.pack(">I", 100_000)),), ((b"sBIT", b"\1"),)])
    def test_feature_grey_png_of_any_bits_is_depth_to_the_number(self, bits, more, tmp_path):
        values = np.random.default_rng(bits).integers(0, 2**bits - (bits == 16), (ROWS, COLUMNS, 1))
        values.flat[0], path = 1, tmp_path / "a.png"
        path.write_bytes(png(values, bits, 0, *more))
        depth, valid = read_depth(path, 0.5)
        np.testing.assert_array_equal(valid[0], values[..., 0] > 0)
        np.testing.assert_array_equal(depth[valid], 0.5 * values[values > 0])
        np.testing.assert_allclose(read_linear(path)[0], values[..., 0] / (2**bits - 1), atol=1e-6)

    @pytest.mark.parametrize("bits", [1, 4, 8, 16])
    def test_feature_a_transparent_grey_level_is_unknown_depth(self, bits, tmp_path):
        """GDAL marks missing values in this way."""
        values = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS, 1) % 2 ** min(bits, 5)
        (tmp_path / "a.png").write_bytes(png(values, bits, 0, (b"tRNS", struct.pack(">H", 1))))
        if bits == 1:
            with pytest.raises(ValueError, match="no valid depth"):
                read_depth(tmp_path / "a.png")
            return
        valid = read_depth(tmp_path / "a.png").valid[0].numpy()
        np.testing.assert_array_equal(valid, values[..., 0] > 1)
        assert float(read_image(tmp_path / "a.png").max()) == pytest.approx(values.max() / (2**bits - 1))

    def test_exception_depth_that_was_scaled_up_from_fewer_bits(self, tmp_path):
        twelve, path = np.arange(500, 500 + ROWS * COLUMNS).reshape(ROWS, COLUMNS, 1), tmp_path / "a.png"
        for stored in (twelve << 4, twelve << 4 | twelve >> 8):  # with zeros, and as PNG asks for
            path.write_bytes(png(stored, 16, 0, (b"sBIT", b"\x0c")))
            with pytest.raises(ValueError, match=r"of 12 bits were scaled up to 16 \(sBIT\)"):
                read_depth(path, 0.001)
        path.write_bytes(png(twelve, 16, 0, (b"sBIT", b"\x0c")))
        np.testing.assert_array_equal(read_depth(path).depth[0], twelve[..., 0])

    @pytest.mark.parametrize("bits", [8, 16])
    def test_feature_grey_with_alpha_is_grey_and_transparent_depth_is_unknown(self, bits, tmp_path):
        values = np.random.default_rng(0).integers(1, 2**bits - 1, (ROWS, COLUMNS, 2))
        values[::2, :, 1] = 0
        head = f"P7 \nWIDTH {COLUMNS}\nHEIGHT {ROWS}\nDEPTH 2\nMAXVAL {2**bits - 1}\nTUPLTYPE GRAYSCALE_ALPHA\nENDHDR\n"
        pam = head.encode() + values.astype(f">u{bits // 8}").tobytes()
        for data in (png(values, bits, 4), pam):
            (tmp_path / "a").write_bytes(data)
            depth, valid = read_depth(tmp_path / "a")
            np.testing.assert_array_equal(valid[0], values[..., 1] > 0)
            np.testing.assert_array_equal(depth[valid], values[1::2, :, 0].ravel())
            np.testing.assert_allclose(read_image(tmp_path / "a")[0], values[..., 0] / (2**bits - 1), atol=1e-6)

    @pytest.mark.parametrize(
        ("linear", "data"),
        [(True, chunks(GAMMA)), (True, chunks((b"cICP", bytes((1, 8, 0, 1))))),
         *((True, profiled("PNG", curve)) for curve in CURVES[:-1]),
         *((True, profiled(kind, CURVES[0])) for kind in FORMATS),
         *((False, profiled(kind, CURVES[-1])) for kind in FORMATS), (False, chunks(GAMMA, (b"sRGB", b"\0"))),
         (False, chunks((b"cICP", bytes((1, 13, 0, 1))), GAMMA)), (False, chunks((b"gAMA", b"\0\0\xb1\x8f")))],
    )  # fmt: skip
    def test_feature_linear_light_is_told_unless_it_is_asked_for(self, linear, data, tmp_path):
        (tmp_path / "a").write_bytes(data)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            np.testing.assert_allclose(read_linear(tmp_path / "a") * 255, 99, atol=2)
            assert not told
            np.testing.assert_allclose(read_image(tmp_path / "a") * 255, 99, atol=2)
        assert [str(warning.message).count("give color_space='linear'") for warning in told] == [1] * linear

    @pytest.mark.parametrize(
        ("chunk", "sentence"),
        [((9, 16, 0, 1), r"encoded by PQ \(transfer characteristics 16\).* view transform"),
         ((9, 18, 0, 1), "encoded by HLG"), ((1, 13, 0, 0), r"do not span the whole range \(cICP")],
    )  # fmt: skip
    def test_exception_a_picture_of_video_but_not_depth(self, chunk, sentence, tmp_path):
        values, path = np.full((ROWS, COLUMNS, 1), 99), tmp_path / "a"
        path.write_bytes(png(values, 8, 0, (b"cICP", bytes(chunk)), GAMMA))
        with pytest.raises(ValueError, match=sentence):
            read_image(path)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            np.testing.assert_array_equal(read_depth(path).depth, 99)

    @pytest.mark.parametrize("bits", [1, 2, 4, 8])
    @pytest.mark.parametrize("alpha", [(), ((b"tRNS", bytes((0, 128))),)])
    def test_feature_a_palette_is_a_picture_and_no_depth(self, bits, alpha, tmp_path):
        values = np.random.default_rng(0).integers(0, 2**bits, (ROWS, COLUMNS, 1))
        palette = (b"PLTE", PALETTE[: 2**bits].tobytes())
        (tmp_path / "a.png").write_bytes(png(values, bits, 3, palette, *alpha))
        found = read_image(tmp_path / "a.png").permute(1, 2, 0)
        np.testing.assert_allclose(found * 255, PALETTE[values[..., 0]], atol=1e-4)
        (tmp_path / "b.png").write_bytes(bmp(8, 0, bytes(range(8)), GREY[::-1]))
        for name in ("a.png", "b.png"):
            with pytest.raises(ValueError, match="the colours of a palette"):
                read_depth(tmp_path / name)
        (tmp_path / "a.jpg").write_bytes(jpeg("L"))
        with pytest.warns(UserWarning, match="is a JPEG, whose compression changes numbers"):
            read_depth(tmp_path / "a.jpg", 0.01)

    @pytest.mark.parametrize(("bits", "kind"), [(8, 2), (16, 2), (8, 6), (16, 6)])
    def test_feature_colours_keep_their_numbers_and_alpha_is_dropped(self, bits, kind, tmp_path):
        values = np.random.default_rng(0).integers(0, 2**bits, (ROWS, COLUMNS, 3 if kind == 2 else 4))
        first = struct.pack(">HHH", *values[0, 0, :3])
        still = b"acTL", struct.pack(">II", 1, 0)  # an animation of one picture
        for chunks in ((), ((b"tRNS", first),) if kind == 2 else ((b"bKGD", first), still)):
            (tmp_path / "a.png").write_bytes(png(values, bits, kind, *chunks))
            found = read_image(tmp_path / "a.png").permute(1, 2, 0)
            np.testing.assert_allclose(found, values[..., :3] / (2**bits - 1), atol=1e-6)

    @pytest.mark.parametrize("name", REFUSED)
    @pytest.mark.parametrize("read", [read_image, read_depth])
    def test_exception_kinds_that_are_not_decoded_are_named(self, read, name, tmp_path):
        make, sentence = REFUSED[name]
        (tmp_path / "a").write_bytes(make())
        with pytest.raises(ValueError, match=sentence):
            read(tmp_path / "a")

    @pytest.mark.parametrize(
        ("data", "error"),
        [
            (bmp(1, 0, bytes((0xA0, 0, 0, 0, 0x50, 0, 0, 0)), bytes(4) + b"\xff\xff\xff\0"), 0),
            (bmp(4, 0, bytes((0x12, 0x34, 0, 0, 0x56, 0x78, 0, 0)), PALETTE[:64].tobytes()[:64]), 0),
            (bmp(8, 0, bytes(range(8)), GREY), 0),
            (bmp(8, 1, bytes((2, 7, 2, 9, 0, 0, 4, 200, 0, 1)), GREY), 0),
            (bmp(4, 2, bytes((4, 0x12, 0, 0, 4, 0x34, 0, 1)), GREY[: 4 * 16]), 0),
            (bmp(24, 0, bytes(range(24))), 0),
            (bmp(32, 0, bytes(range(32))), 0),
            (bmp(32, 3, bytes(range(32)), b"", struct.pack("<III", 0xFF0000, 0xFF00, 0xFF)), 0),
            *(
                (jpeg(**given), 4)
                for given in ({"mode": "L"}, {"progressive": True}, {"keep_rgb": True}, {"subsampling": 2})
            ),
        ],
        ids=["1", "4", "8", "RLE8", "RLE4", "24", "32", "masks", "JPEG", "progressive", "RGB JPEG", "subsampled"],
    )
    def test_feature_bmp_and_jpeg_as_pillow_reads_them(self, data, error, tmp_path):
        """Decoders of JPEG round in their own ways."""
        (tmp_path / "a").write_bytes(data)
        theirs = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        found = read_image(tmp_path / "a").expand(3, -1, -1).permute(1, 2, 0) * 255
        np.testing.assert_allclose(found, theirs, atol=error + 1e-4)

    @pytest.mark.parametrize(("place", "beginning", "name"), [*OTHERS, *RAW])
    def test_exception_other_formats_are_named(self, place, beginning, name, tmp_path):
        (tmp_path / "a").write_bytes(bytes(place) + beginning + bytes(99))
        raw = rf"a camera raw file \({name}\): develop it by kornia-tidy raw develop"
        other = f"{name}, not an image in a known format: PNG, "
        with pytest.raises(ValueError, match=f"it is {raw if (place, beginning, name) in RAW else other}"):
            read_image(tmp_path / "a")
