"""Measured response of a panel, read from a text file: one column of phases, or two of grey levels and phases."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence

from kornia_tidy.files import error_prefix, read_text
from kornia_tidy.modulator.phase_panel import check_response, tell_short_span

LONGEST = 1000  # characters of a line of the header that count
RADIANS = {"radians": 1.0, "milliradians": 1e-3, "degrees": math.pi / 180, "pi": math.pi, "waves": 2 * math.pi}
# Words of a header, in lower case.
_UNITS = {
    "radians": r"(?<![a-z])(rad|rads|radians?)(?![a-z])",
    "milliradians": r"(?<![a-z])(mrad|milliradians?)(?![a-z])",
    "degrees": r"((?<![a-z])(deg|degrees?)(?![a-z])|°)(?!\s*(c|celsius)\b)",
    "pi": r"(?<![a-z0-9.])(?<!2 )(pi|π)(?![a-z])",
    "waves": r"(?<![a-z])(waves?|cycles?|turns?|revolutions?)(?![a-z])|(?<![0-9.])2 ?(pi|π)(?![a-z])"
    r"|[(\[/] ?(λ|lambda|wavelengths?) ?([)\]]|$)",
}
_PHASE = r"phase|phi(?![a-z])|φ|retard|modulation|shift|opd(?![a-z])|opl(?![a-z])"
_OTHER_UNITS = re.compile(
    rf"(?:{_PHASE})[^,;\t(\[]*[(\[] ?(nm|[uµμ]m|%|nanomet\w+|micromet\w+|percent|v|volts?|gon|grad|gradians?|arcmin\w*"
    r"|[^)\]]*/ ?\d+ ?(?:pi|π)?) ?[)\]]"
)
_FORM = "a response has one phase for each grey level, or two columns, level and phase"

_Row = tuple[int, tuple[float, ...]]
"""Number of a line, and its numbers."""


def read_response(path: str | os.PathLike[str], bits: int) -> list[float]:
    r"""Read the measured phase of each grey level of a panel from a text file.

    Args:
        path: of the file. Each line is one phase, in the order of the levels, or a level and its phase, in any order
            of lines; all phases may stand in one line. Separators are commas, semicolons, tabs or spaces. Decimals have
            a point, or a comma where semicolons separate.
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
    unit = _unit(path, ", ".join(text for text in header if _names_phases(text)))
    if len(rows) == 1:
        rows = [(rows[0][0], (number,)) for number in rows[0][1]]
    first, width = rows[0][0], len(rows[0][1])
    if width > 2:
        raise ValueError(
            f"cannot read {path}: {_FORM}, and line {first} has {width} numbers (write decimals with a point)"
        )
    for line, numbers in rows:
        if len(numbers) != width:
            raise ValueError(
                f"cannot read {path}: {_FORM}, and line {first} has {width} numbers and line {line} {len(numbers)}"
            )
    if width == 2:
        rows = _in_order(path, rows, 2**bits)
    phases = [RADIANS[unit] * numbers[-1] for _, numbers in rows]
    with error_prefix(f"cannot read {path}"):
        check_response(phases, bits, [line for line, _ in rows])
    span = max(phases) - min(phases)
    tell_short_span(
        span,
        bits,
        f"the response in {path} spans {span:.3g} rad, read as {unit}: if its phases are in another unit, name "
        f"that in a header, such as 'phase (deg)', 'phase (pi)' or 'phase (waves)'",
    )
    return phases


def _rows(path: str | os.PathLike[str]) -> tuple[list[str], list[_Row]]:
    """Return the lines of the header and the lines of numbers."""
    header, found = [], []
    for line, whole in enumerate(read_text(path, "replace").splitlines(), 1):
        data = re.split("[#%]", whole, maxsplit=1)[0].replace('"', " ").strip().rstrip(" \t;,")
        cells = data.replace(",", ".").split(";") if ";" in data else re.split(r"[\s,]+", data)
        try:
            numbers = tuple(float(cell) for cell in cells) if data else ()
        except ValueError:
            if found:
                raise ValueError(f"cannot read {path}: {_FORM}, and line {line} is {data!r:.80}") from None
            numbers = ()
        if numbers:
            found.append((line, numbers))
        elif not found and whole.strip():
            header.append(_plain(whole[:LONGEST]))
    if not found:
        raise ValueError(f"cannot read {path}: {_FORM}, as text, and no line has only numbers")
    return header, found


def _plain(text: str) -> str:
    """Return a line of a header in lower case, without quotes, ranges and the sign of a comment."""
    text = re.sub(r"(?<!\w)\ufffd(?!\w)", "°", text.lower().replace('"', " "))  # as Windows' Latin-1 has it
    text = re.sub(r"[ \t]*\*[ \t]*| +", " ", text).strip("#% ")
    return re.sub(r"(mod\w*|0 ?(-|–|to|\.+|…)) ?2 ?(pi|π)", "", text)


def _names_phases(text: str) -> bool:
    """Return whether a line of a header names the column of phases, or only units and levels."""
    return bool(re.search(_PHASE, text)) or not re.search(r"[^\W\d_]", re.sub("|".join(_UNITS.values()), "", text))


def _unit(path: str | os.PathLike[str], heading: str) -> str:
    """Return the unit of phases by their heading, radians if it has none."""
    if other := _OTHER_UNITS.search(heading):
        raise ValueError(
            f"cannot read {path}: its header gives phases in {other[1]}, and read are radians, degrees, pi and waves"
        )
    found = [unit for unit, words in _UNITS.items() if re.search(words, heading)]
    if found == ["radians", "pi"]:
        return "pi"  # "pi rad"
    if len(found) > 1:
        raise ValueError(f"cannot read {path}: its header gives phases in {' and in '.join(found)}, {heading!r:.80}")
    return found[0] if found else "radians"


def _in_order(path: str | os.PathLike[str], rows: Sequence[_Row], count: int) -> list[_Row]:
    """Return the level and the phase of each level of a panel, in their order."""
    levels = list(range(count))
    first, second = (sorted(numbers[column] for _, numbers in rows) == levels for column in (0, 1))
    panel = f"the levels of a panel of {(count - 1).bit_length()} bits are 0 to {count - 1}"
    by_level: dict[float, _Row] = {}
    for line, numbers in rows:
        level, phase = numbers[::-1] if second and not first else numbers
        if level not in levels:
            raise ValueError(f"cannot read {path}: {panel}, and line {line} has {level:g} (--bits tells how many)")
        if level in by_level:
            raise ValueError(f"cannot read {path}: level {level:g} is in line {by_level[level][0]} and {line}")
        by_level[level] = line, (level, phase)
    if missing := [level for level in levels if level not in by_level]:
        shown = ", ".join(map(str, missing[:3])) + (", ..." if len(missing) > 3 else "")
        raise ValueError(
            f"cannot read {path}: {panel}, and {len(missing)} are missing ({shown}): interpolate the phases to every "
            f"level, as np.interp does, or give the --bits of the panel"
        )
    return [by_level[level] for level in levels]
