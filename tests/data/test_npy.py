from __future__ import annotations

import io
import re
import struct

import numpy as np
import pytest

from kornia_tidy.data.npy import decode_npy
from tests.base import BaseTester


def npy(values, version=(1, 0)):
    file = io.BytesIO()
    np.lib.format.write_array(file, values, version=version)
    return file.getvalue()


def npy_of(header: str, values: bytes = bytes(16)):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode("latin-1") + values


class TestDecodeNpy(BaseTester):
    @pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
    @pytest.mark.parametrize("kind", ["u1", ">u2", "<i4", ">f4", "<f8", "<f2", "?", "<c8"])
    @pytest.mark.parametrize("shape", [(2, 3), (6,), (), (1, 2, 3), (0, 3)])
    def test_feature_what_numpy_wrote_is_read(self, kind, shape, version):
        values = np.random.default_rng(0).integers(0, 2, shape).astype(kind)
        read = decode_npy(npy(values, version))
        np.testing.assert_array_equal(read, values)
        assert read.dtype == values.dtype.newbyteorder("=")
        assert read.flags.writeable

    def test_feature_columns_first(self):
        values = np.arange(6.0).reshape(2, 3)
        np.testing.assert_array_equal(decode_npy(npy(np.asfortranarray(values))), values)

    @pytest.mark.parametrize(
        "header",
        [
            "{'descr': '<u1', 'fortran_order': False, 'shape': (16L, 1L), }\n",  # as Python 2 wrote it
            '{"shape": (16,1), "fortran_order": False, "descr": "|u1"}',  # in another order
        ],
    )
    def test_feature_headers_of_others(self, header):
        assert decode_npy(npy_of(header)).shape == (16, 1)

    @pytest.mark.parametrize(
        ("header", "sentence"),
        [
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }", "promises 8000000000000 bytes"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (1, 1), }", "promises 8 bytes of values, there are 16"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 2), }", "does not tell data type"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (2", "does not tell data type"),
            ("{'descr': '<f8', 'fortran_order': Tr\xe9e, 'shape': (2,), }", "does not tell data type"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': " + "(" * 9000, "does not tell data type"),
            ("{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 9000 + ")}", "9000 axes, more than 8"),
            ("{'descr': '<f99', 'fortran_order': False, 'shape': (2,), }", "'<f99', which is none of numbers"),
            ("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", "'|O', which is none of numbers"),
            ("{'descr': [('x', '<f8')], 'fortran_order': False, 'shape': (2,), }", "'a record', which is none"),
            ("__import__('os').abort()", "does not tell data type"),
        ],
    )
    def test_exception_a_header_that_cannot_be(self, header, sentence):
        with pytest.raises(ValueError, match=re.escape(sentence)):
            decode_npy(npy_of(header))

    @pytest.mark.parametrize("kept", [0, 6, 7, 9, 11, 60, 128, 143])
    def test_exception_cut_short(self, kept):
        with pytest.raises(ValueError, match="NPY"):
            decode_npy(npy(np.zeros(2))[:kept])
