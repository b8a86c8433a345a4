"""NPZ archives of one array, as NumPy writes them; everything else in an archive is named."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest

from kornia_tidy.data import read_depth, read_image
from kornia_tidy.data.npz import decode_npz
from tests.base import BaseTester


def npz(*arrays, save=np.savez, **named):
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def archive(members, method=zipfile.ZIP_STORED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as zipped:
        for name, data in members.items():
            zipped.writestr(name, data)
    return file.getvalue()


def header(shape, kind="<f4"):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


class TestDecodeNpz(BaseTester):
    @pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
    @pytest.mark.parametrize("kind", ["u1", ">u2", "<i8", "<f2", ">f4", "<f8"])
    def test_feature_one_array_is_read_as_numpy_reads_it(self, save, kind):
        for values in (
            np.arange(300 * 200).reshape(300, 200).astype(kind),
            np.asfortranarray(np.ones((4, 5, 3), kind)),
        ):
            for data in (npz(values, save=save), npz(depth=values, save=save)):
                np.testing.assert_array_equal(decode_npz(data), values)

    def test_feature_depth_and_picture(self, tmp_path):
        (tmp_path / "a.npz").write_bytes(npz(depth=np.array([[500, 0, 2000]], np.uint16)))
        assert read_depth(tmp_path / "a.npz", 0.001).depth[0].tolist() == [[0.5, 0.5, 2.0]]
        (tmp_path / "a.npz").write_bytes(npz(np.full((2, 3, 3), 51, np.uint8)))
        assert float(read_image(tmp_path / "a.npz").mean()) == pytest.approx(0.2)

    @pytest.mark.parametrize(
        ("data", "sentence"),
        [
            (npz(depth=np.ones((2, 2)), K=np.eye(3)), r"its NPZ holds 2 arrays, depth\.npy, K\.npy, and one is read"),
            (npz(), "cannot read .*: it is an empty ZIP"),
            (archive({"a.txt": b"x"}), r"a ZIP archive without arrays, it holds a\.txt"),
            (archive({"archive/data.pkl": b"x"}), r"a ZIP archive without arrays, it holds archive/data\.pkl"),
            (npz(np.array([{"code": 1}])), "'.O', which is none of numbers"),
            (npz(np.ones((1, 20, 30))), r"channels come last, .* \(1, 20, 30\): save array\[0\]"),
            (archive({"a.npy": header((10**6, 10**6))}), "the array has 1000000 x 1000000 pixels, more than"),
            (archive({"a.npy": header((10**4, 10**4))}), r"promises 4000000\d\d bytes, the archive \d+"),
            (archive({"a.npy": header((2, 2)) + bytes(999)}), r"promises \d\d bytes, the archive \d+"),
            (archive({"a.npy": header((2, 2)) + bytes(16)}, zipfile.ZIP_BZIP2), "compressed by method 12"),
            (npz(np.ones(9))[:-30], "cut short or damaged"),
            (npz(np.ones(9))[:200], "cut short or damaged"),
            (npz(np.ones((9, 9))).replace(b"\xf0?", b"\xf1?", 1), "its NPZ is damaged: Bad CRC-32"),
        ],
    )
    def test_exception_the_sentence_names_what_was_found(self, data, sentence, tmp_path):
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(ValueError, match=sentence):
            read_depth(tmp_path / "a.npz")

    def test_exception_encrypted(self):
        data = bytearray(npz(np.ones((2, 2))))
        data[6] |= 1
        data[data.index(b"PK\1\2") + 8] |= 1
        with pytest.raises(ValueError, match="encrypted"):
            decode_npz(bytes(data))
