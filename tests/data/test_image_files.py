"""Image files: exact round trips, channel order, and one clear sentence for everything that is not an image."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import read_image, write_image
from tests.base import BaseTester


def random_image(channels: int, bits: int) -> torch.Tensor:
    return torch.randint(0, 2**bits, (channels, 12, 17)).double() / (2**bits - 1)


class TestReadImage(BaseTester):
    @pytest.mark.parametrize("suffix", [".npy", ".tiff", ".pfm"])
    def test_feature_floats_are_taken_as_they_are(self, suffix, tmp_path):
        values = np.random.default_rng(0).random((6, 5, 3)).astype(np.float32)
        path = tmp_path / f"a{suffix}"
        if suffix == ".npy":
            np.save(path, values)
        else:
            cv2.imwrite(str(path), values[..., ::-1])
        np.testing.assert_array_equal(read_image(path), values.transpose(2, 0, 1))

    @pytest.mark.parametrize(("stored_type", "top"), [(np.uint8, 255), (np.uint16, 65535)])
    def test_feature_integer_arrays_are_scaled(self, stored_type, top, tmp_path):
        np.save(tmp_path / "a.npy", np.array([[0, 51, top]], stored_type))
        self.assert_close(read_image(tmp_path / "a.npy"), torch.tensor([[[0, 51 / top, 1.0]]]), rtol=1e-6, atol=0)

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            (np.full((2, 2), 1.5), r"floats must lie in \[0, 1\], found 1.5 to 1.5"),
            (np.full((2, 2), np.nan), r"floats must lie in \[0, 1\], found nan"),
            (np.zeros((2, 2), np.int32), "not int32"),
            (np.zeros((2, 2), complex), "not complex128"),
            (np.zeros((2, 2), bool), "not bool"),
            (np.zeros((2, 2, 5)), "this has 5"),
            (np.zeros((1, 2, 5)), r"channels come last, .*, and its shape is \(1, 2, 5\): save array\[0\]"),
            (np.zeros((3, 2, 5)), r"channels come last, .* \(3, 2, 5\): save np.moveaxis\(array, 0, -1\)"),
            (np.zeros((4, 3, 2, 5)), r"rows, columns and channels, this is \(4, 3, 2, 5\)"),
            (np.zeros(7), r"rows, columns and channels, this is \(7,\)"),
            (np.zeros((0, 3)), "rows, columns and channels"),
            (np.array([{"code": "never run"}]), "names the data type '.O', which is none of numbers"),
        ],
    )
    def test_exception_array_is_no_image(self, values, message, tmp_path):
        np.save(tmp_path / "a.npy", values, allow_pickle=True)
        with pytest.raises(ValueError, match=f"a.npy.*{message}"):
            read_image(tmp_path / "a.npy")

    def test_exception_jpeg_with_a_thumbnail_is_cut_short(self, tmp_path):
        """The end marker of the thumbnail in its header does not count."""
        data = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8))[1].tobytes()
        small = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
        whole = data[:2] + b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small + data[2:]
        (tmp_path / "a.jpg").write_bytes(whole + b"some camera's notes")
        assert read_image(tmp_path / "a.jpg").shape == (1, 40, 60)
        (tmp_path / "a.jpg").write_bytes(whole[: -len(data) // 3])
        with pytest.raises(ValueError, match="cut short"):
            read_image(tmp_path / "a.jpg")

    @pytest.mark.parametrize("content", [b"this is a letter, not a picture", b"\x89PNG\r\n\x1a\n", bytes(500), b"P"])
    def test_exception_text_under_the_name_of_an_image(self, content, tmp_path, capfd):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot read .*a\.png: (it is not an image|the file is cut short)"):
            read_image(tmp_path / "a.png")
        assert capfd.readouterr().err == ""

    def test_exception_missing_empty_or_folder(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"none\.png: there is no such file"):
            read_image(tmp_path / "none.png")
        with pytest.raises(ValueError, match="it is a folder"):
            read_image(tmp_path)
        (tmp_path / "empty.png").touch()
        with pytest.raises(ValueError, match=r"empty\.png: the file is empty"):
            read_image(tmp_path / "empty.png")

    def test_feature_opencv_logs_again_after_a_bad_file(self, tmp_path):
        before = cv2.utils.logging.getLogLevel()
        (tmp_path / "a.png").write_bytes(b"text")
        with pytest.raises(ValueError, match="not an image"):
            read_image(tmp_path / "a.png")
        assert cv2.utils.logging.getLogLevel() == before


class TestWriteImage(BaseTester):
    @pytest.mark.parametrize("channels", [1, 3])
    @pytest.mark.parametrize("bits", [8, 16])
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".TIFF"])
    def test_feature_round_trip_is_exact(self, channels, bits, suffix, dtype, tmp_path):
        image = random_image(channels, bits)
        write_image(tmp_path / f"a{suffix}", image.to(dtype), bits=bits)
        self.assert_close(read_image(tmp_path / f"a{suffix}"), image.float(), rtol=0, atol=1e-7)

    def test_feature_values_are_clipped_and_rounded(self, tmp_path):
        image = torch.tensor([[[-0.2, 0.5019, 0.5, 1.7]]], requires_grad=True)
        write_image(tmp_path / "a.png", image)
        assert (read_image(tmp_path / "a.png") * 255).round().flatten().tolist() == [0, 128, 128, 255]

    @pytest.mark.parametrize(
        ("name", "image", "options", "message"),
        [
            ("a.bmp", torch.zeros(1, 2, 2), {}, "suffix of an image file must be one of .*'.bmp'"),
            ("a", torch.zeros(1, 2, 2), {}, "suffix of an image file must be one of .*''"),
            ("a.jpg", torch.zeros(1, 2, 2), {"bits": 16}, "bits of a .jpg file must be one of 8, got 16"),
            ("a.png", torch.zeros(1, 2, 2), {"bits": 12}, "must be one of 8, 16, got 12"),
            ("a.png", torch.zeros(4, 2, 2), {}, r"\(4, 2, 2\)"),
            ("a.png", torch.zeros(1, 3, 2, 2), {}, r"\(1, 3, 2, 2\)"),
            ("a.png", torch.zeros(3, 0, 2), {}, r"\(3, 0, 2\)"),
            ("a.png", torch.full((1, 2, 2), float("inf")), {}, "image must be finite, got inf"),
        ],
    )
    def test_exception_names_the_bad_value(self, name, image, options, message, tmp_path):
        with pytest.raises(ValueError, match=message):
            write_image(tmp_path / name, image, **options)

    def test_exception_integers_no_folder_or_a_folder(self, tmp_path):
        with pytest.raises(TypeError, match="uint8"):
            write_image(tmp_path / "a.png", torch.zeros(1, 2, 2).byte())
        with pytest.raises(FileNotFoundError, match=r"there is no folder .*none"):
            write_image(tmp_path / "none" / "a.png", torch.zeros(1, 2, 2))
        (tmp_path / "a.png").mkdir()
        with pytest.raises(ValueError, match="it is a folder"):
            write_image(tmp_path / "a.png", torch.zeros(1, 2, 2))
