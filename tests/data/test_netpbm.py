"""PBM, PGM, PPM and PAM files against the arrays that were written, and against Netpbm's own tools."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from kornia_tidy.data import read_depth, read_image
from kornia_tidy.data.netpbm import decode_netpbm
from tests.base import BaseTester

MAXIMA = (1, 2, 3, 15, 100, 127, 200, 254, 255, 256, 257, 1000, 1023, 4095, 16383, 65534, 65535)
SIZES = ((1, 1), (3, 7), (2, 8), (5, 9), (4, 17))
TUPLES = (  # of PAM: name, channels, of which grey or colours
    ("BLACKANDWHITE", 1, 1), ("GRAYSCALE", 1, 1), ("RGB", 3, 3), ("BLACKANDWHITE_ALPHA", 2, 1),
    ("GRAYSCALE_ALPHA", 2, 1), ("RGB_ALPHA", 4, 3), ("", 1, 1), ("", 3, 3), ("disparity", 1, 1),
)  # fmt: skip
HEADERS = (  # with places for kind, columns, rows, and the maximum behind a blank
    "{0}\n{1} {2}{3}\n", "{0} {1}\t{2}{3} ", "{0}\r\n{1}\v{2}{3}\f", "{0}\n# GIMP\n#\n{1} #{2} rows\n {2}{3}\n",
    "{0}#\n\n{1}#\n{2}{3}#x\n", "{0}\n000{1} 0{2}{3}\r\n",
)  # fmt: skip


def samples(kind: int, values: np.ndarray, white: int, number: int) -> bytes:
    """Values (H, W, C) in the form of a kind of file; of a bitmap they are black where 1."""
    if kind == 4:
        return np.packbits(values[..., 0].astype(np.uint8), axis=1).tobytes()
    if kind > 4:
        return values.astype(">u2" if white > 255 else "u1").tobytes()
    words = [str(value) for value in values.ravel()]
    blank = (" ", "\n", " \t\r\n")[number % 3]
    if kind == 1 and number % 2:
        return "".join(words).encode()
    text = blank.join(words)
    return (text.replace(blank, f"{blank}# a comment\n", 1) if number % 2 else f" {text}\n").encode()


def combinations():
    """Yield a file, the numbers that were written, without alpha, and the maximum."""
    random = np.random.default_rng(0)
    for number, (kind, white, header) in enumerate(itertools.product((2, 3, 5, 6), MAXIMA, HEADERS)):
        shape = (*SIZES[number % len(SIZES)], 3 if kind in {3, 6} else 1)
        values = random.integers(0, white + 1, shape)
        values.flat[0] = white
        head = header.format(f"P{kind}", shape[1], shape[0], f" {white}").encode()
        yield head + samples(kind, values, white, number), values, white
    for number, (kind, size, header) in enumerate(itertools.product((1, 4), SIZES, HEADERS)):
        bits = random.integers(0, 2, (*size, 1))
        head = header.format(f"P{kind}", size[1], size[0], "").encode()
        yield head + samples(kind, bits, 1, number), 1 - bits, 1
    for number, (white, (name, channels, colours)) in enumerate(itertools.product(MAXIMA, TUPLES)):
        rows, columns = SIZES[number % len(SIZES)]
        values = random.integers(0, white + 1, (rows, columns, channels))
        values[..., colours:] = values[..., colours:].clip(min=1)  # visible
        kinds = "".join(f"TUPLTYPE {part}\n" for part in ([name] if name else []))
        lines = (
            f"WIDTH {columns}\n",
            f"HEIGHT  {rows} \n",
            f"DEPTH {channels}\n",
            f"MAXVAL\t{white}\n",
            kinds,
            "# x\n\n",
        )
        head = "P7\n" + "".join(lines[:: -1 if number % 2 else 1]) + "ENDHDR\n"
        yield head.encode() + samples(7, values, white, 0), values[..., :colours], white


class TestDecodeNetpbm(BaseTester):
    def test_feature_every_kind_maximum_header_and_size_is_read_to_the_number(self, tmp_path):
        path, count = tmp_path / "a.pnm", 0
        for data, values, white in combinations():
            count += 1
            path.write_bytes(data)
            found = read_image(path).permute(1, 2, 0).double().numpy()
            np.testing.assert_allclose(found * white, values, atol=1e-3, err_msg=str(data[:80]))
            if data.startswith((b"P1", b"P4")):
                with pytest.raises(ValueError, match="a bitmap"):
                    read_depth(path)
            elif values.shape[2] == 1 and ((values > 0) & (values < 65535)).any():
                depth, valid = read_depth(path, 0.5, invalid=[] if white < 65535 else [65535])
                known = (values > 0) & (values < 65535)
                np.testing.assert_array_equal(valid[0], known[..., 0])
                np.testing.assert_array_equal(depth[valid], 0.5 * values[known], err_msg=str(data[:80]))
        assert count >= 600

    def test_exception_every_combination_cut_short_too_long_or_twice_in_a_file(self):
        for data, _, _ in combinations():
            plain = data[:2] in {b"P1", b"P2", b"P3"}
            with pytest.raises(ValueError, match=r"cut short|promises"):
                decode_netpbm(re.sub(rb"(\d|(?<=\s)\d+)\s*\Z", b"", data) if plain else data[: -1 - (b"\r\n" in data)])
            with pytest.raises(ValueError, match="promises"):
                decode_netpbm(data + (b" 1" if plain else b"\0\0\0"))
            with pytest.raises(ValueError, match="whole numbers|digits" if plain else "several pictures|promises"):
                decode_netpbm(data + data)

    def test_exception_samples_above_the_maximum(self):
        for data in (b"P2 2 1 99\n5 100", b"P5 2 1 99\n\5\144", b"P6 1 1 999\n\0\1\3\350\0\0",
                     b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 1\nMAXVAL 99\nENDHDR\n\144"):  # fmt: skip
            with pytest.raises(ValueError, match=r"it holds 100.*, more than the maximum 99"):
                decode_netpbm(data)

    @pytest.mark.parametrize(
        ("data", "sentence"),
        [
            (b"P5 2 2 0\n1234", "its maximum must be 1 to 65535, it is 0"),
            (b"P5 2 2 65536\n12341234", "its maximum must be 1 to 65535, it is 65536"),
            (b"P5 2 -2 255\n1234", "whole numbers"),
            (b"P5" + b" " * 100_000 + b"x", "its Netpbm header is cut short or damaged"),
            (b"P5" + b"#\n" * 100_000 + b"x", "its Netpbm header is cut short or damaged"),
            (b"P2 1000000 1000000 9\n1", "has 1000000 x 1000000 pixels, more than"),
            (b"P2 1 1 9\n1e1", "its samples must be whole numbers"),
            (b"P2 1 1 9\n-1", "its samples must be whole numbers"),
            (b"P2 1 1 9\n" + b"9" * 400, "it holds inf, more than the maximum 9"),
            (b"P2 1 1 9\n99999999999999999999", "it holds 1e[+]20, more than the maximum 9"),
            (b"P1 1 1\n2", "its samples must be digits 0 and 1"),
            (b"P7 332\n", "its first line is not that of a PAM file"),
            (b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 1\nMAXVAL 1\n\0", "its PAM header is cut short"),
            (b"P7\nWIDTH 1\nHEIGHT 1\nMAXVAL 1\nENDHDR\n\0", "must give WIDTH, HEIGHT, DEPTH and MAXVAL"),
            (b"P7\nWIDTH 1\nWIDTH 2\nENDHDR\n\0", "has the line 'WIDTH 2'"),
            (b"P7\nWIDTH x\nENDHDR\n\0", "has the line 'WIDTH x'"),
            (b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 4\nMAXVAL 9\nTUPLTYPE CMYK\nENDHDR\n\0\0\0\0", "its TUPLTYPE is 'CMYK'"),
            (b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 2\nMAXVAL 9\nENDHDR\n\0\0", "its 2 channels is unknown: .* missing"),
            (
                b"P7\nWIDTH 1\nHEIGHT 1\nDEPTH 3\nMAXVAL 9\nTUPLTYPE GRAYSCALE\nENDHDR\n\0\0\0",
                "TUPLTYPE is 'GRAYSCALE'",
            ),
        ],
    )
    def test_exception_the_sentence_names_the_property(self, data, sentence):
        with pytest.raises(ValueError, match=sentence):
            decode_netpbm(data)
