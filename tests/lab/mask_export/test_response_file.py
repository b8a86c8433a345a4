"""Measured responses as programs and people write them, and curves that no panel has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.mask_export import read_response
from tests.base import BaseTester

PLAIN = np.linspace(0, 6.5, 256)
UNITS = {  # words beside "phase" in a header, and radians in one
    "(rad)": 1.0,
    "[radians]": 1.0,
    "": 1.0,
    "/ mrad": 1e-3,
    "(deg)": math.pi / 180,
    "[°]": math.pi / 180,
    "in degrees": math.pi / 180,
    "[pi]": math.pi,
    "/ π": math.pi,
    "(pi rad)": math.pi,
    "(waves)": 2 * math.pi,
    "/ 2pi": 2 * math.pi,
    "(units of 2 * π)": 2 * math.pi,
    "(λ)": 2 * math.pi,
    "[wavelengths]": 2 * math.pi,
    "modulo 2π (rad)": 1.0,
}
SEPARATORS = (",", ", ", ";", " ; ", "\t", " ", "   ")
LEVELS = ("Level", "grey level", "GL", "Gray_value", "index")


@st.composite
def curves(draw):
    """Radians of the levels of a panel: rising or falling within 0 to 4 pi, maybe flat at places."""
    bits = draw(st.integers(1, 6))
    steps = draw(st.lists(st.integers(0, 9), min_size=2**bits - 1, max_size=2**bits - 1).filter(any))
    low = draw(st.floats(0, 4))
    curve = low + np.cumsum([0, *steps]) * (draw(st.floats(3.1, 8.5)) / sum(steps))
    return bits, curve if draw(st.booleans()) else curve[::-1]


@st.composite
def files(draw):
    """Bits, phases and a file of them in one of the usual forms."""
    bits, curve = draw(curves())
    unit = draw(st.sampled_from(list(UNITS)))
    separator = draw(st.sampled_from(SEPARATORS))
    form = draw(st.sampled_from(["{:.6f}", "{:.9e}", '"{:.8f}"']))
    printed = [form.format(value) for value in np.asarray(curve) / UNITS[unit]]
    expected = [float(text.strip('"')) * UNITS[unit] for text in printed]
    columns = draw(st.sampled_from(["phase", "level phase", "phase level"]))
    in_one_line = columns == "phase" and draw(st.booleans())
    decimal = "," if separator.strip() == ";" and (in_one_line or columns != "phase") and draw(st.booleans()) else "."
    printed = [text.replace(".", decimal) for text in printed]
    heading = f"Phase {unit}"
    if columns == "phase":
        lines = [separator.join(printed)] if in_one_line else printed
    else:
        level_form = draw(st.sampled_from(["{:d}", "{:.1f}", "{:.18e}"]))
        pairs = [(level_form.format(g).replace(".", decimal), phase) for g, phase in enumerate(printed)]
        pairs = draw(st.permutations(pairs))
        lines = [separator.join(pair if columns == "level phase" else pair[::-1]) for pair in pairs]
        level = draw(st.sampled_from(LEVELS))
        heading = separator.join([level, heading] if columns == "level phase" else [heading, level])
    if unit or draw(st.booleans()):
        lines = [draw(st.sampled_from(["", "# ", "%"])) + heading, *lines]
    notes = draw(st.lists(st.sampled_from(["# panel 7, 532 nm, 23 °C", "", "% 2024-05-01", "Vendor LUT", "sep=;"])))
    notes = [note for note in notes if note != "sep=;" or separator == ";"]
    end = draw(st.sampled_from(["\n", "\r\n"]))
    text = end.join([*notes, *lines]) + draw(st.sampled_from(["", end, end + end, end + "# end" + end]))
    encoding = draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]))
    return bits, expected, text.encode(encoding)


class TestReadResponse(BaseTester):
    @settings(max_examples=40, deadline=None)
    @given(files())
    def test_property_any_curve_in_any_form_comes_back(self, tmp_path_factory, file):
        bits, expected, data = file
        path = tmp_path_factory.getbasetemp() / "lut.txt"
        path.write_bytes(data)
        assert read_response(path, bits) == pytest.approx(expected, rel=1e-12, abs=1e-12)

    @pytest.mark.parametrize(
        "text",
        [
            "\n".join(f"{g},{p:.4f}" for g, p in enumerate(PLAIN)),
            "\n".join(f"{g};{p:.4f}".replace(".", ",") for g, p in enumerate(PLAIN)),
            "Level,Phase (deg)\n" + "\n".join(f"{g},{math.degrees(p):.2f}" for g, p in enumerate(PLAIN)),
            "Level;Phase\n-;deg\n"
            + "\n".join(f"{g};{math.degrees(p):.2f}".replace(".", ",") for g, p in enumerate(PLAIN)),
            "# grey level   phase / rad\n" + "\n".join(f"{g:5d} {p:9.4f}  # ok" for g, p in enumerate(PLAIN)),
            ", ".join(f"{p:.4f}" for p in PLAIN),
        ],
    )
    def test_feature_usual_files(self, text, tmp_path):
        (tmp_path / "lut.csv").write_text(text)
        assert read_response(tmp_path / "lut.csv", 8) == pytest.approx(PLAIN, abs=1e-4)

    def test_exception_a_unit_that_is_not_read(self, tmp_path):
        for unit, word in (("nm", "Phase shift"), ("π/2", "phase"), ("nm", "OPD"), ("grad", "Phase")):
            (tmp_path / "lut.csv").write_text(f"Level (%), {word} ({unit})\n0,0\n1,1.5\n2,3\n3,4.5", encoding="utf-8")
            with pytest.raises(ValueError, match=f"header gives phases in {unit}, and read are radians"):
                read_response(tmp_path / "lut.csv", 2)
        (tmp_path / "lut.csv").write_text("Level (%), Phase shift (rad)\n0,0\n1,1.5\n2,3\n3,4.5")
        assert read_response(tmp_path / "lut.csv", 2) == [0, 1.5, 3, 4.5]

    def test_feature_whole_degrees_behind_commas_are_a_column(self, tmp_path):
        (tmp_path / "lut.csv").write_text("level,phase deg\n0,0\n1,120\n2,240\n3,350\n")
        assert read_response(tmp_path / "lut.csv", 2) == pytest.approx(np.radians([0, 120, 240, 350]))

    def test_feature_degrees_in_the_signs_of_old_windows(self, tmp_path):
        (tmp_path / "lut.csv").write_bytes("Größe;Phase [°]\r\n0;0\r\n1;180,5\r\n".encode("latin-1"))
        assert read_response(tmp_path / "lut.csv", 1) == pytest.approx([0, math.radians(180.5)])

    @pytest.mark.parametrize(
        ("text", "bits", "sentence"),
        [
            ("0\n3\n2\n6", 2, r"rise or fall throughout, got 2 at level 2 \(line 3\) after 3: smooth noise, .*unwrap"),
            ("# rad\n3;6\n2;4,5\n0;0\n1;4,75", 2, r"throughout, got 4.5 at level 2 \(line 3\) after 4.75"),
            ("0 0 0 0", 2, "must rise or fall, got 0 at every level"),
            ("-0.1 1 2 3", 2, r"0 to 4 pi rad, got -0.1 at level 0 \(line 1\): add a constant"),
            ("0 1 2 12.6", 2, r"0 to 4 pi rad, got 12.6 at level 3 \(line 1\): multiply degrees"),
            ("0,0\n1,90\n2,180\n3,270", 2, r"got 90 at level 1 \(line 2\): multiply degrees by pi / 180"),
            ("level,drive\n0,0\n1,21845\n2,43690\n3,65535", 2, "do not give drive values for phases"),
            ("0\n21845\n43690\n65535", 2, "do not give drive values for phases"),
            ("0,0\n0,5\n1,7\n3,2", 2, "level 0 is in line 1 and 2"),
            ("0\t0,0\n1\t2,5", 1, "line 1 has 3 numbers .write decimals with a point"),
            ("0\n1\n2", 2, "must have 4 phases, one for each level of 2 bits, got 3"),
            ("0 0\n1 1\n3 6", 2, r"levels of a panel of 2 bits are 0 to 3, and 1 are missing \(2\): interpolate"),
            ("0 0\n1 1\n2 3\n2 5", 2, "level 2 is in line 3 and 4"),
            ("0 0\n1 1\n2 3\n4 5", 2, r"are 0 to 3, and line 4 has 4 \(--bits"),
            ("0 0\n21845 1\n43690 3\n65535 5", 2, "are 0 to 3, and line 2 has 21845"),
            ("phase level\n0.1 0\n1.2 1\n2.3 2\n3.4 5", 2, "are 0 to 3, and line 2 has 0.1"),
            ("0 0\n1 1\n2\n3 5", 2, "line 1 has 2 numbers and line 3 1"),
            ("0 0 9\n1 1 9\n2 3 9\n3 6 9", 2, "and line 1 has 3 numbers"),
            ("phase (deg)\nphase in rad\n0\n1\n2\n3", 2, "phases in radians and in degrees, 'phase"),
            ("0 0\n1 O.5\n2 3\n3 6", 2, r"line 2 is '1 O\.5'"),
            ("0 1.5 nan 4", 2, r"got nan at level 2 \(line 1\): .*interpolate unknown ones"),
            ("0;0\n1;1.234,5\n2;3\n3;6", 2, "line 2 is '1;1.234,5'"),
            ("calibration\nof panel 7", 2, "no line has only numbers"),
            (5000 * "x", 2, "no line has only numbers"),
        ],
    )
    def test_exception_names_what_was_found_and_where(self, text, bits, sentence, tmp_path):
        (tmp_path / "lut.csv").write_text(text)
        with pytest.raises(ValueError, match=rf"^cannot read .*lut\.csv: .*{sentence}") as told:
            read_response(tmp_path / "lut.csv", bits)
        assert len(str(told.value).replace(str(tmp_path), "")) < 260

    @pytest.mark.parametrize("unit", [math.pi, 2 * math.pi])
    def test_feature_units_that_no_header_names_are_told(self, unit, tmp_path):
        (tmp_path / "lut.csv").write_text("\n".join(f"{g},{p / unit:.5f}" for g, p in enumerate(PLAIN)))
        with pytest.warns(UserWarning, match=r"spans [12]\.\d+ rad, read as radians: .*header, such as"):
            read_response(tmp_path / "lut.csv", 8)
