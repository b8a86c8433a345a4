"""Measured response of a panel, read from a text file: one column of phases, or two of grey levels and phases."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Sequence
from typing import NamedTuple

from kornia_tidy.files import read_text
from kornia_tidy.modulator.phase_panel import check_response

LONGEST = 1000  # characters of a line of the header that count
SHORT = 3.0  # rad; a smaller span is not a whole wave, and in units of pi panels have it
RADIANS = {"radians": 1.0, "milliradians": 1e-3, "degrees": math.pi / 180, "pi": math.pi, "waves": 2 * math.pi}
# Words of a header, in lower case.
_UNITS = {
    "radians": r"(?<![a-z])(rad|rads|radians?)(?![a-z])",
    "milliradians": r"(?<![a-z])(mrad|milliradians?)(?![a-z])",
    "degrees": r"((?<![a-z])(deg|degrees?)(?![a-z])|°)(?!\s*(c|celsius)\b)",
    "pi": r"(?<![a-z0-9.])(?<!2 )(pi|π)(?![a-z])",
    "waves": r"(?<![a-z])(waves?|cycles?|turns?)(?![a-z])|(?<![0-9.])2 ?(pi|π)(?![a-z])|[(\[/] ?(λ|lambda) ?([)\]]|$)",
}
_PHASE = r"phase|phi(?![a-z])|φ|retard|modulation|shift"
_LEVEL = r"level|gr[ae]y|(?<![a-z])(gl|gv|index|lut|input|code|value|pixel)(?![a-z])"
_NOT_FINITE = re.compile(r"[-+]?(nan|inf|infinity)", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?")
_FORM = "a response has one phase for each grey level, or two columns, level and phase"


class _Row(NamedTuple):
    """Numbers of a line, or its text where it holds none, with the number of the line."""

    line: int
    text: str
    numbers: tuple[float, ...] = ()


def read_response(path: str | os.PathLike[str], bits: int) -> list[float]:
    r"""Read the measured phase of each grey level of a panel from a text file.

    Args:
        path: of the file. Each line is one phase, in the order of the levels, or a level and its phase, in any order
            of lines; all phases may stand in one line. With more columns a header names *level* and *phase*.
            Separators are commas, semicolons, tabs or spaces; with a decimal comma they are semicolons, tabs or spaces.
        bits: bits b of the panel.

    Returns:
        The :math:`2^b` phases in radians.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if a level is missing, given twice or not of the panel, or
            :func:`~kornia_tidy.modulator.phase_panel.check_response` does; the message names the line.

    Convention:
        - Text before the first row and after ``#`` or ``%`` is header. Its words *deg*, *degrees*, *°*,
          *mrad*, *pi*, *π*, *waves* and *2 pi* are units of the phases beside *phase* or on their own.
          Without, phases are radians.
        - A warning tells of a span of less than 3 rad, as phases in another unit have.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "lut.csv").write_text("Level;Phase (deg)\n0;0\n1;57,3\n3;286,5\n2;171,9\n")
        ...     [round(phase, 3) for phase in read_response(f"{folder}/lut.csv", bits=2)]
        [0.0, 1.0, 3.0, 5.0]
    """
    header, rows = _rows(path)
    header = [row for row in header if _names_phases(row.text)]
    column, heading = 0, ", ".join(row.text for row in header)
    if len(rows) == 1:
        rows = [_Row(rows[0].line, "", (number,)) for number in rows[0].numbers]
    first = rows[0]
    for row in rows:
        if len(row.numbers) != len(first.numbers):
            counts = f"line {first.line} has {len(first.numbers)} numbers and line {row.line} {len(row.numbers)}"
            raise ValueError(f"cannot read {path}: {_FORM}, and {counts}")
    if len(first.numbers) > 1:
        level, column, heading = _columns(path, rows, header)
        rows = _in_order(path, rows, level, 2**bits)
    unit = _unit(path, heading)
    phases = [RADIANS[unit] * row.numbers[column] for row in rows]
    try:
        check_response(phases, bits, [row.line for row in rows])
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from None
    if (span := max(phases) - min(phases)) < SHORT and bits > 1:
        warnings.warn(
            f"the response in {path} spans {span:.3g} rad, read as {unit}: if its phases are in another unit, name "
            f"that in a header, such as 'phase (deg)', 'phase (pi)' or 'phase (waves)'",
            stacklevel=2,
        )
    return phases


def _rows(path: str | os.PathLike[str]) -> tuple[list[_Row], list[_Row]]:
    """Return the lines of the header and the lines of numbers."""
    header, found = [], []
    for line, whole in enumerate(read_text(path, "replace").splitlines(), 1):
        data = re.split("[#%]", whole, maxsplit=1)[0].replace('"', " ").strip().rstrip(" \t;,")
        cells = [cell for cell in re.split(r"[\s;,]+", data) if cell]
        bad = [cell for cell in cells if not _NUMBER.fullmatch(cell)]
        if cells and not bad:
            found.append(_Row(line, data))
        elif bad and (found or _NOT_FINITE.fullmatch(bad[0])):
            raise ValueError(f"cannot read {path}: {_FORM}, as numbers, and line {line} has {bad[0]!r:.80}")
        elif not found and whole.strip():
            header.append(_Row(line, _plain(whole[:LONGEST])))
    if not found:
        raise ValueError(f"cannot read {path}: {_FORM}, as text, and no line has only numbers")
    try:
        separator, decimal = _punctuation([row.text for row in found], header)
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from None
    rows = []
    for row in found:
        try:
            numbers = tuple(float(cell.replace(decimal, ".")) for cell in re.split(separator, row.text))
        except ValueError:
            raise ValueError(
                f"cannot read {path}: {_FORM}, as numbers, and line {row.line} is {row.text!r:.80}"
            ) from None
        rows.append(_Row(row.line, row.text, numbers))
    return header, rows


def _plain(text: str) -> str:
    """Return a line of a header in lower case, without quotes, ranges and the sign of a comment."""
    text = re.sub(r"(?<!\w)\ufffd(?!\w)", "°", text.lower().replace('"', " "))  # as Windows' Latin-1 has it
    text = re.sub(r"[ \t]*\*[ \t]*| +", " ", text).strip("#% ")
    return re.sub(r"(mod\w*|0 ?(-|–|to|\.+|…)) ?2 ?(pi|π)", "", text)


def _punctuation(rows: Sequence[str], header: Sequence[_Row]) -> tuple[str, str]:
    """Return the pattern of what separates numbers, and the sign of their decimals."""
    text = "\n".join(rows)
    if ";" in text:
        return ";", ","
    if "," not in text:
        return r"\s+", "."
    if "." in text or re.search(r",[ \t]|[ \t],", text):
        return r"[\s,]+", "."
    if re.search(r"[ \t]", text):
        return r"\s+", ","
    if max(row.count(",") for row in rows) > 1:
        return ",", "."
    # One comma in a line: between a level and a whole number of degrees, or before decimals.
    pairs = [row.partition(",") for row in rows]
    levels = sorted(float(first or 0) for first, _, _ in pairs) == list(range(len(rows)))
    degrees = all(re.fullmatch(r"0|[1-9]\d{0,2}", second) for _, _, second in pairs)
    columns = levels and (degrees or any(re.search(f"({_LEVEL}).*,", row.text) for row in header))
    if levels and not columns and all(re.fullmatch(r"0|[1-9]\d*", second) for _, _, second in pairs):
        raise ValueError(
            f"lines such as {rows[-1]!r:.80} may be a level and a whole number, or one phase with a decimal comma: "
            f"separate columns by ';', or write decimals with a point"
        )
    return (",", ".") if columns else (r"\s+", ",")


def _names_phases(text: str) -> bool:
    """Return whether a line of a header names the column of phases, or only units and levels."""
    return bool(re.search(_PHASE, text)) or not re.search(r"[^\W\d_]", re.sub("|".join(_UNITS.values()), "", text))


def _unit(path: str | os.PathLike[str], heading: str) -> str:
    """Return the unit of phases by their heading, radians if it has none."""
    found = [unit for unit, words in _UNITS.items() if re.search(words, heading)]
    if found == ["radians", "pi"]:
        return "pi"  # "pi rad"
    if len(found) > 1:
        raise ValueError(f"cannot read {path}: its header gives phases in {' and in '.join(found)}, {heading!r:.80}")
    return found[0] if found else "radians"


def _columns(path: str | os.PathLike[str], rows: Sequence[_Row], header: Sequence[_Row]) -> tuple[int, int, str]:
    """Return the columns of levels and of phases, and the heading of the phases."""
    width, heading = len(rows[0].numbers), ", ".join(row.text for row in header)
    for row in reversed(header):
        cells = [cell for cell in re.split(r"[;,\t]+|\s{2,}", row.text) if cell.strip()]
        cells = cells if len(cells) == width else row.text.split()
        if len(cells) == width:
            phases = [k for k, cell in enumerate(cells) if re.search(_PHASE, cell)]
            levels = [k for k, cell in enumerate(cells) if re.search(_LEVEL, cell) and k not in phases]
            if len(phases) == len(levels) == 1:
                return levels[0], phases[0], cells[phases[0]] if width > 2 else heading
    if width > 2:
        raise ValueError(
            f"cannot read {path}: {_FORM}, or a header that names them among others, and line {rows[0].line} has "
            f"{width} numbers"
        )
    wanted = list(range(len(rows)))
    swapped = sorted(row.numbers[0] for row in rows) != wanted == sorted(row.numbers[1] for row in rows)
    return int(swapped), int(not swapped), heading


def _in_order(path: str | os.PathLike[str], rows: Sequence[_Row], column: int, count: int) -> list[_Row]:
    """Return one row for each level of a panel, in their order."""
    panel = f"the levels of a panel of {(count - 1).bit_length()} bits are 0 to {count - 1}"
    by_level: dict[float, _Row] = {}
    for row in rows:
        level = row.numbers[column]
        if level not in range(count):
            raise ValueError(f"cannot read {path}: {panel}, and line {row.line} has {level:g} (--bits tells how many)")
        if level in by_level:
            raise ValueError(f"cannot read {path}: level {level:g} is in line {by_level[level].line} and {row.line}")
        by_level[level] = row
    if missing := [level for level in range(count) if level not in by_level]:
        shown = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        raise ValueError(
            f"cannot read {path}: {panel}, and {len(missing)} are missing ({shown}): interpolate the phases to every "
            f"level, as np.interp does, or give the --bits of the panel"
        )
    return [by_level[level] for level in range(count)]
