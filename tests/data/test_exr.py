"""Depth in OpenEXR files as renderers write it, against the arrays that were written by the format's own library."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest

from kornia_tidy.data import read_depth, read_image
from kornia_tidy.data.exr import decode_exr
from tests.base import BaseTester

H, W = 37, 53
DEPTH = (np.random.default_rng(0).random((H, W)) * 90 + 0.5).astype(np.float32)
OTHER = np.random.default_rng(1).random((H, W)).astype(np.float16)


@pytest.fixture(scope="module")
def library():
    return pytest.importorskip("OpenEXR", reason="the package OpenEXR is not installed")


def exr(library, channels, **header):
    file = io.BytesIO()
    library.File({"type": library.scanlineimage, **header}, channels).write(file)
    return file.getvalue()


def window(left, top, right, bottom):
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def colours(layer="", values=OTHER, names="RGBA"):
    return {f"{layer}{name}": values for name in names}


VIEW = "ViewLayer."
LAYERS = {
    "Z": {"Z": DEPTH},
    "any name where it is the only one": {"foo.bar": DEPTH},
    "grey": {"Y": DEPTH},
    "beside a picture": {**colours(), "Z": DEPTH},
    "Blender's layers": {
        **colours(f"{VIEW}Combined."), f"{VIEW}Depth.Z": DEPTH, f"{VIEW}Mist.Z": OTHER,
        f"{VIEW}Denoising Depth.Z": OTHER, **colours(f"{VIEW}Normal.", names="XYZ"),
        **colours(f"{VIEW}UV.", names="UVA"), **colours(f"{VIEW}Vector.", names="XYZW"),
        f"{VIEW}IndexOB.X": OTHER, **colours(f"{VIEW}CryptoObject00.", names="rgba"),
    },
    "Blender's file output": {**colours("Image."), "Depth.V": DEPTH},
    "a grey layer by its name": {**colours(), **colours("WorldDepth.", DEPTH)},
    "Mitsuba": {**colours(), "depth.T": DEPTH},
    "grey as red, green and blue": colours("", DEPTH, "RGB"),
    "the same with alpha": {**colours("", DEPTH, "RGB"), "A": OTHER},
}  # fmt: skip
UNCLEAR = {
    "two layers": ({"left.Z": DEPTH, "right.Z": DEPTH}, "it may be any of left.Z, right.Z"),
    "a picture": ({"R": DEPTH, "G": OTHER, "B": DEPTH}, "its red, green and blue differ: of B, G, R write only one"),
    "vectors": (colours("Normal.", names="XYZ"), "none is named for it: of Normal.X, Normal.Y, Normal.Z"),
    "mist": ({**colours(), "Mist.Z": OTHER}, "none is named for it"),
    "only mist": ({"View.Mist.Z": OTHER}, "none is named for it: of View.Mist.Z"),
    "only alpha": ({"A": OTHER}, "none is named for it: of A"),
}


class TestDecodeExr(BaseTester):
    @pytest.mark.parametrize("name", LAYERS)
    def test_feature_the_channel_of_depth_is_found(self, name, library, tmp_path):
        (tmp_path / "a.exr").write_bytes(exr(library, LAYERS[name]))
        depth, valid = read_depth(tmp_path / "a.exr")
        np.testing.assert_array_equal(depth[0], DEPTH)
        assert bool(valid.all())

    @pytest.mark.parametrize("name", UNCLEAR)
    def test_exception_where_it_is_not_clear_the_channels_are_listed(self, name, library):
        channels, sentence = UNCLEAR[name]
        with pytest.raises(ValueError, match=f"which channel of its OpenEXR is depth is not clear, {sentence}"):
            decode_exr(exr(library, channels))

    def test_feature_every_type_compression_and_layout(self, library):
        """Against what the library itself reads; those without loss also against the array."""
        lossy = {"B44_COMPRESSION", "B44A_COMPRESSION", "PXR24_COMPRESSION"}
        names = [name for name in dir(library) if name.endswith("_COMPRESSION") and "J2K" not in name]
        assert len(names) >= 10
        for name in names:
            for kind in (np.float32, np.float16, np.uint32):
                for tiled in (False, True):
                    layout = {"type": library.tiledimage, "tiles": library.TileDescription()} if tiled else {}
                    values = DEPTH.astype(kind)
                    data = exr(library, {"Z": values, "Y": values}, compression=getattr(library, name), **layout)
                    found, unknown = decode_exr(data)
                    assert found.dtype == kind
                    assert unknown is None
                    if name not in lossy or kind == np.uint32:
                        np.testing.assert_array_equal(found, values, err_msg=name)
                    theirs = library.File(io.BytesIO(data), separate_channels=True).channels()["Z"].pixels
                    np.testing.assert_array_equal(found, theirs)

    def test_feature_parts_of_a_file(self, library):
        parts = [
            library.Part({"type": library.scanlineimage, "name": name}, channels, name)
            for name, channels in (("beauty", colours()), ("depth", {"Y": DEPTH}), ("id", {"Y": OTHER}))
        ]
        file = io.BytesIO()
        library.File(parts).write(file)
        np.testing.assert_array_equal(decode_exr(file.getvalue())[0], DEPTH)

    @pytest.mark.parametrize(
        "display",
        [(0, 0, 99, 79), (10, 5, 62, 41), (20, 15, 30, 25), (0, 10, 40, 99), (30, 0, 90, 20), (200, 0, 220, 9)],
    )
    def test_convention_pixels_are_those_of_the_display_window(self, display, library):
        """Those outside the data window are unknown; each pixel is compared by its coordinates."""
        data = exr(
            library, {"Z": DEPTH}, dataWindow=window(10, 5, 10 + W - 1, 5 + H - 1), displayWindow=window(*display)
        )
        values, unknown = decode_exr(data)
        left, top, right, bottom = display
        assert values.shape == (bottom - top + 1, right - left + 1)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                inside = 10 <= x < 10 + W and 5 <= y < 5 + H
                assert inside == (unknown is None or not unknown[y - top, x - left])
                assert values[y - top, x - left] == (DEPTH[y - 5, x - 10] if inside else 0)

    def test_feature_unknown_and_endless_depth(self, library, tmp_path):
        stored = np.array([[2, 0, np.nan, 1e10, np.inf, -1]], np.float32)
        (tmp_path / "a.exr").write_bytes(exr(library, {"Z": stored}))
        depth, valid = read_depth(tmp_path / "a.exr", 0.5)
        assert valid[0].tolist() == [[True, False, False, True, True, False]]
        assert depth[valid].tolist() == [1, 5e9, float("inf")]

    def test_feature_the_largest_half_is_told(self, library, tmp_path):
        (tmp_path / "a.exr").write_bytes(exr(library, {"Z": np.array([[2, 65504]], np.float16)}))
        with pytest.warns(UserWarning, match=r"holds 65504 where its other values end at 2, .* invalid=\[65504\]"):
            read_depth(tmp_path / "a.exr")

    def test_feature_texts_that_are_not_utf_8_are_no_damage(self, library):
        data = exr(library, {"Z": DEPTH}, comments="é", owner="éé").replace(b"\xc3\xa9", b"\xe9\xe8")
        np.testing.assert_array_equal(decode_exr(data)[0], DEPTH)

    def test_exception_many_channels_are_limited_together(self, library, monkeypatch):
        monkeypatch.setenv("KORNIA_TIDY_MAX_PIXELS", str(H * W))
        decode_exr(exr(library, {**colours(names="RGB"), "Z": DEPTH}))
        with pytest.raises(ValueError, match="the file, its 5 channels by fours, has"):
            decode_exr(exr(library, {**colours(), "Z": DEPTH}))

    def test_exception_a_display_window_that_is_almost_empty(self, library):
        data = exr(library, {"Z": DEPTH}, displayWindow=window(0, 0, 9999, 9999))
        with pytest.raises(ValueError, match=r"holds \(37, 53\) pixels of a display window of \(10000, 10000\)"):
            decode_exr(data)

    def test_exception_jpeg_2000(self, library):
        if not hasattr(library, "HTJ2K32_COMPRESSION"):
            pytest.skip("this OpenEXR has no compression by JPEG 2000")
        with pytest.raises(ValueError, match="compressed by JPEG 2000"):
            decode_exr(exr(library, {"Z": DEPTH}, compression=library.HTJ2K32_COMPRESSION))

    def test_exception_tiles_that_the_file_cannot_hold(self, library):
        data = exr(library, {"Z": DEPTH}, type=library.tiledimage, tiles=library.TileDescription())
        place = data.index(b"tiledesc\0") + len(b"tiledesc\0") + 4
        with pytest.raises(ValueError, match="the file is cut short: no compression makes its picture as small"):
            decode_exr(data[:place] + np.array([32, 1 << 25], "<u4").tobytes() + data[place + 8 :])

    def test_exception_deep_data(self, library):
        samples = np.empty((3, 4), object)
        for place in np.ndindex(3, 4):
            samples[place] = np.ones(2, np.float32)
        data = exr(library, {"Z": samples}, type=library.deepscanline, compression=library.ZIPS_COMPRESSION)
        with pytest.raises(ValueError, match="it is a deep OpenEXR, with several depths a pixel"):
            decode_exr(data)

    def test_exception_a_picture_in_linear_light_is_not_read_as_codes(self, library, tmp_path):
        (tmp_path / "a.exr").write_bytes(exr(library, colours()))
        with pytest.raises(ValueError, match="OpenEXR holds linear light"):
            read_image(tmp_path / "a.exr")

    def test_exception_without_the_package(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "OpenEXR", None)
        (tmp_path / "a.exr").write_bytes(b"v/1\x01" + bytes(99))
        with pytest.raises(ImportError, match=r"pip install 'kornia-tidy\[exr\]'"):
            read_depth(tmp_path / "a.exr")
