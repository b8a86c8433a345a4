"""Kodak C330: files without a header that LibRaw tells by their length, and that must look like its pictures."""

from __future__ import annotations

import io

import numpy as np
import pytest
import rawpy

from kornia_tidy.lab.raw import RawCapture, develop
from tests.base import BaseTester
from tests.lab.raw.c330 import LENGTHS, ramp


class TestKodakC330(BaseTester):
    @pytest.mark.parametrize("length", LENGTHS)
    def test_feature_three_planes_of_libraws_four(self, length):
        """LibRaw returns four planes: three of linear sRGB and an empty one."""
        data = ramp(length)
        with pytest.warns(
            UserWarning, match=f"has no header: by its length of {length} bytes it is taken for a picture"
        ):
            raw = RawCapture.open(data)
        with rawpy.imread(io.BytesIO(data)) as file:
            theirs = file.raw_image_visible.copy()
        assert theirs.shape == (912, 1216, 4)
        assert not theirs[..., 3].any()
        np.testing.assert_array_equal(raw.counts.permute(1, 2, 0).numpy(), theirs[..., :3])
        assert (raw.pattern, raw.colors, raw.white, raw.info.camera) == (None, "RGB", 65535, "Kodak C330")
        picture = develop(raw, encoded=False)
        self.assert_close(picture, raw.counts / 65535, atol=1e-6)
        grey = picture[:, :600]
        assert (grey.amax(0) - grey.amin(0)).max() == 0
        assert (grey[0].diff(dim=1) >= 0).all()
        assert (picture[0, 600:750] > picture[1:, 600:750].amax(0)).all()
        assert (picture[2, 750:] > picture[:2, 750:].amax(0)).all()

    @pytest.mark.parametrize("length", LENGTHS)
    def test_exception_other_bytes_of_that_length(self, length):
        text = (b"the quick brown fox jumps over the lazy dog; " * (length // 45 + 1))[:length]
        counts = (1000 + np.arange(length // 2) % 1232 * 37).astype("<u2").tobytes()
        for data in (text, counts, np.random.default_rng(0).bytes(length), bytes(length)):
            with pytest.raises(ValueError, match="does not begin as raw files do"):
                RawCapture.open(data)
