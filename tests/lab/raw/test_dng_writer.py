"""DNG files as LibRaw reads them, which we did not write."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
import rawpy
import torch

from kornia_tidy.lab.raw import RawCapture, RawInfo
from kornia_tidy.lab.raw.dng_writer import encode_dng, write_dng
from kornia_tidy.lab.raw.filter_array import indexed_tile
from tests.base import BaseTester
from tests.lab.raw.dng import XTRANS
from tests.lab.raw.dng_kinds import QUAD, QUAD_WHITE

MATRIX = torch.tensor([[0.9, -0.3, -0.1], [-0.8, 1.6, 0.3], [-0.3, 0.3, 0.8]])


def capture(pattern="RGGB", bits=12, size=(64, 96), channels=1, **changes):
    """Random counts from 0 to white."""
    generator = torch.Generator().manual_seed(bits)
    counts = torch.randint(0, 2**bits, (channels, *size), generator=generator)
    return replace(RawCapture.from_counts(counts, pattern, 2**bits // 16, 2**bits - 1), **changes)


class TestDng(BaseTester):
    @pytest.mark.parametrize("size", [(64, 96), (65, 97)])
    @pytest.mark.parametrize("bits", [10, 12, 14, 16])
    @pytest.mark.parametrize(
        ("pattern", "channels"),
        [(p, 1) for p in ("RGGB", "BGGR", "GBRG", "GRBG", "GMYC", "CMYG", XTRANS, None)] + [(None, 3)],
    )
    def test_feature_libraw_reads_the_same_counts(self, pattern, channels, bits, size):
        raw = capture(pattern, bits, size, channels)
        with rawpy.imread(io.BytesIO(encode_dng(raw))) as file:
            seen = file.raw_image_visible.copy()
            assert file.white_level == 2**bits - 1
            assert file.black_level_per_channel[:3] == [2**bits // 16] * 3
            if raw.pattern is not None:
                assert file.color_desc.decode()[:3] == raw.colors[:3]
            if pattern is not None and len(pattern) == 4:
                assert tuple(map(tuple, file.raw_pattern.tolist())) == raw.pattern
        planes = seen[None] if seen.ndim == 2 else seen[..., :3].transpose(2, 0, 1)
        assert np.array_equal(planes, raw.counts.numpy())

    @pytest.mark.parametrize(("pattern", "bits"), [("RGGB", 12), ("BGGR", 14), ("GBRG", 16), ("GRBG", 12)])
    def test_feature_opens_as_the_same_capture(self, tmp_path, pattern, bits):
        info = RawInfo("Acme", "One", "Prime 50", 800.0, 1 / 125, 2.8, 0.05, datetime(2024, 1, 2, 3, 4, 5))
        balance = torch.tensor([2.0, 1.0, 1.6, 1.0])
        tile = torch.tensor([[2**bits // 16, 200.0], [250.0, 251.0]])
        raw = capture(pattern, bits, white_balance=balance, xyz_to_camera=MATRIX, flip=6, info=info, black=tile)
        write_dng(tmp_path / "a.dng", raw)
        back = RawCapture.open(tmp_path / "a.dng")
        assert torch.equal(back.counts, raw.counts)
        assert (back.pattern, back.colors, back.white, back.flip) == (raw.pattern, raw.colors, raw.white, 6)
        assert torch.equal(back.black, raw.black)
        self.assert_close(back.white_balance, balance)
        assert (back.info.make, back.info.model, back.info.iso, back.info.lens) == ("Acme", "One", 800.0, "Prime 50")
        assert back.info.timestamp == info.timestamp
        assert [back.info.exposure, back.info.aperture, back.info.focal_length] == pytest.approx([1 / 125, 2.8, 0.05])
        again = RawCapture.open(encode_dng(back))
        self.assert_close(again.camera_to_srgb, back.camera_to_srgb, rtol=0, atol=1e-4)

    @pytest.mark.parametrize(
        ("letters", "planes"), [(QUAD, "RGB"), (QUAD_WHITE, "RGBW"), ("RGWB", "RGBW"), ("RYYB", "RYB"), (None, "RGBW")]
    )
    def test_feature_other_arrays_open_as_the_same_capture(self, letters, planes):
        raw, balance = capture(None, channels=3 if letters is None else 1), 1 + torch.arange(len(planes)) / 8
        if letters is None:
            raw = replace(raw, counts=raw.counts[[0, 1, 2, 0]], colors=planes, black=raw.black[[0, 1, 2, 0]])
        else:
            side = round(len(letters) ** 0.5)
            tile, colors = indexed_tile([letters[i : i + side] for i in range(0, len(letters), side)], planes)
            raw = replace(raw, pattern=tile, colors=colors, black=raw.black.expand(side, side))
        raw = replace(raw, white_balance=balance / balance[max(planes.find("G"), 0)])
        back = RawCapture.open(encode_dng(raw))
        assert torch.equal(back.counts, raw.counts)
        assert (back.pattern, back.colors, back.white) == (raw.pattern, raw.colors, raw.white)
        assert torch.equal(back.black, raw.black)
        self.assert_close(back.white_balance, raw.white_balance)

    def test_feature_the_matrix_is_libraws(self):
        """LibRaw's own conversion of grey under D65 is grey, and its matrix is that of the rows divided by white's."""
        from_srgb = np.array([[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])
        forward = MATRIX.double().numpy() @ from_srgb
        expected = np.linalg.inv(forward / forward.sum(1, keepdims=True))
        with rawpy.imread(io.BytesIO(encode_dng(capture(xyz_to_camera=MATRIX)))) as file:
            assert np.abs(file.color_matrix[:, :3] - expected).max() < 2e-3

    @pytest.mark.parametrize("flip", range(8))
    def test_feature_orientation(self, flip):
        with rawpy.imread(io.BytesIO(encode_dng(capture(flip=flip)))) as file:
            assert file.sizes.flip == flip

    def test_feature_pixels_that_are_not_square(self):
        with rawpy.imread(io.BytesIO(encode_dng(capture(pixel_aspect=1.5)))) as file:
            assert file.sizes.pixel_aspect == pytest.approx(1.5)

    def test_exception_counts_that_do_not_fit(self):
        raw = capture()
        with pytest.raises(ValueError, match="counts must lie in 0 to 65535, found -1 to"):
            encode_dng(replace(raw, counts=raw.counts.clone().index_fill_(1, torch.tensor([0]), -1)))
        with pytest.raises(ValueError, match=r"needs one pixel or more, got counts of shape \(1, 0, 4\)"):
            encode_dng(replace(raw, counts=raw.counts[:, :0, :4]))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"flip": 8}, "flip must be one of 0, 1, 3, 2, 4, 6, 7, 5, got 8"),
            ({"white": 1e6}, "white must be a count from 1 to 65535, got 1000000.0"),
            ({"white": math.nan}, "white must be a count"),
            ({"pixel_aspect": math.nan}, "pixel_aspect must be positive"),
            ({"black": torch.full((2, 2), -5.0)}, "black must be counts of zero or more, got -5.0"),
            ({"white_balance": torch.zeros(4)}, "white_balance must be positive factors, got 0.0"),
            ({"xyz_to_camera": torch.full((3, 3), math.nan)}, "xyz_to_camera must be finite, got nan"),
        ],
    )
    def test_exception_descriptions_of_no_sensor(self, change, message):
        with pytest.raises(ValueError, match=message):
            encode_dng(replace(capture(), **change))

    def test_feature_exposures_that_are_none_are_left_out(self):
        info = RawInfo(iso=math.nan, exposure=-1.0, aperture=math.inf, focal_length=0.05)
        back = RawCapture.open(encode_dng(replace(capture(), info=info))).info
        assert (back.iso, back.exposure, back.aperture, back.focal_length) == (None, None, None, 0.05)

    def test_exception_no_folder(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            write_dng(tmp_path / "none" / "a.dng", capture())
