"""PFM against bytes typed by hand and against OpenCV's writer."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from kornia_tidy.data.pfm import decode_pfm, encode_pfm
from tests.base import BaseTester, shared

TOP_DOWN = np.array([[1.5, -2.0, 0.25], [4.0, 5.0, np.inf]], np.float32)  # as a person would look at it
BOTTOM_UP = (4.0, 5.0, float("inf"), 1.5, -2.0, 0.25)  # as the file has it


class TestDecodePfm(BaseTester):
    @pytest.mark.parametrize(
        "header",
        [b"Pf\n3 2\n-1.0\n", b"Pf \n3 2 \n-1.0\n", b"Pf\n3 2\n-0.003922\n", b"Pf\r\n3 2\r\n-1\r\n", b"Pf 3 2 -1e0 \n"],
    )
    def test_feature_reads_little_endian_bytes_typed_by_hand(self, header):
        np.testing.assert_array_equal(decode_pfm(header + struct.pack("<6f", *BOTTOM_UP)), TOP_DOWN)

    def test_feature_reads_big_endian_bytes_typed_by_hand(self):
        values = decode_pfm(b"Pf\n3 2\n1.0\n" + struct.pack(">6f", *BOTTOM_UP))
        np.testing.assert_array_equal(values, TOP_DOWN)
        assert values.dtype.isnative

    @pytest.mark.parametrize("shape", [(5, 7), (1, 1), (4, 3, 3)])
    def test_feature_opencv_and_this_library_read_each_other(self, shape, tmp_path):
        """At scale 1 OpenCV's reader is right; its channels are B, G, R."""
        values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
        swapped = values[..., ::-1] if len(shape) == 3 else values
        cv2.imwrite(str(tmp_path / "theirs.pfm"), swapped)
        np.testing.assert_array_equal(decode_pfm((tmp_path / "theirs.pfm").read_bytes()), values)
        (tmp_path / "ours.pfm").write_bytes(encode_pfm(values))
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "ours.pfm"), cv2.IMREAD_UNCHANGED), swapped)

    def test_feature_written_bytes_are_these(self):
        assert encode_pfm(TOP_DOWN) == b"Pf\n3 2\n-1.0\n" + struct.pack("<6f", *BOTTOM_UP)

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            (b"Pf\n2 2\n-1.0\n" + bytes(15), "promises 16 bytes of values, there are 15"),
            (b"Pf\n2 2\n-1.0\n" + bytes(17), "promises 16 bytes of values, there are 17"),
            (b"Pf\n999999999 999999999\n-1.0\n" + bytes(4), "promises 3999999992000000004 bytes"),
            (b"Pf\n2 2\n0\n" + bytes(16), "scale as 0"),
            (b"Pf\n2 2\n1.2.3\n" + bytes(16), "scale as '1.2.3'"),
            (b"Pf\n2 -2\n-1\n" + bytes(16), "header is not"),
            (b"Pf\n2\n", "header is not"),
            (b"P5\n2 2\n255\n" + bytes(4), "header is not"),
        ],
    )
    def test_exception_says_what_is_wrong(self, data, message):
        with pytest.raises(ValueError, match=message):
            decode_pfm(data)

    def test_feature_reads_flyingthings3d_with_blanks_in_its_header(self):
        """The first four bytes of the values, a3 cd 1f 42, are the bottom left corner."""
        values = decode_pfm(shared("data/rgbd/flyingthings3d_subset/disparity/0000/left/0012.pfm").read_bytes())
        assert values.shape == (540, 960)
        assert values[-1, 0] == struct.unpack("<f", b"\xa3\xcd\x1f\x42")[0]
