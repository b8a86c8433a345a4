"""All rows, their measurement, and the page that shows them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence

from tests.extremes import devices, exposure, gradients, lens, pictures, presets, sensor
from tests.extremes.row import Row

INTRODUCTION = """\
# Extremes

This page lists the error of captures far from usual settings, and the refusals beyond the allowed values. Every row
was measured by
`make extremes`, which writes this page; `tests/extremes/test_extremes.py` checks the quick rows in every test run.

* **Error**: the largest over all values of the row. Where it says float64, the same capture was computed in float64
  with otherwise the same settings; images are random, depths jump between 0.3 m and infinity.
* **Allowed**: the limit in the test. Captures in float32 must be within 1e-4 of full scale.
* **Refused**: `ValueError` or `TypeError` with one sentence, before any work. The table shows the first one.
* **Not measured**: the machine has no device for the row; a machine with the device measures it.
"""

EXPLANATION = """\
## How the error of float32 grows

![Largest error over defocus, masks, window, layers and image](images/extremes_growth.png)

In units of the rounding of float32 (2^-24 of full scale), by the largest error over a capture:

{table}

The error hardly grows with anything, for these reasons:

* Defocus reaches PSFs through integrals over the pixels of the mask, which are computed in float64 and rounded once; a
  large defocus costs no digits. Whole waves of the masks' phase are taken off in float64 before it meets them.
* K masks are averaged: errors are weighted by 1/K each, and a sum of K terms in order adds at most K roundings of a
  value below 1, whose random parts cancel to about their square root.
* PSFs sum to one, so a convolution is a weighted mean: its error is bounded by gamma(n) of
  `tests/rounding.py` times the largest value, and by transforms it grows as the logarithm of their
  size.
* Two neighbouring layers are blended with weights that sum to one, however many layers there are.

That is why captures are computed in float32 by default, half precision is converted first and rounded once at the end,
and only `fidelity="reference"` computes in float64.
"""


def all_rows() -> list[Row]:
    """Return the rows of the page in their order."""
    return [row for part in (lens, exposure, pictures, sensor, gradients, devices, presets) for row in part.rows()]


def measure(row: Row) -> float | str:
    """Return the error of a row, or the sentence of its refusal.

    Raises:
        AssertionError: if the error is beyond the row's bound, or what must be refused was not.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clamped depths and small windows, which rows provoke
        found = row.measure()
    if row.bound is None:
        assert isinstance(found, str), f"{row.name}: not refused"
    else:
        assert isinstance(found, float), f"{row.name}: no error was measured"
        assert not math.isnan(found), f"{row.name}: NaN or infinity"
        assert found <= row.bound, f"{row.name}: error {found:.3g}, allowed {row.bound:.3g}"
    return found


def page(results: Mapping[str, float | str], growth: Mapping[str, Sequence[tuple[float, float]]], made: str) -> str:
    """Return the page as Markdown."""
    parts, rows = [INTRODUCTION, f"{made}\n"], all_rows()
    for group in dict.fromkeys(row.group for row in rows):
        parts.append(
            f"## {group}\n\n| quantity | tried | error | allowed | against, or what happens |\n|---|---|---|---|---|"
        )
        parts.extend(_line(row, results.get(row.name)) for row in rows if row.group == group)
        parts.append("")
    lines = ["| quantity | value: error |", "|---|---|"]
    lines += [
        f"| {quantity} | {', '.join(f'{value:g}: {error:.1f}' for value, error in pairs)} |"
        for quantity, pairs in growth.items()
    ]
    return "\n".join(parts) + "\n" + EXPLANATION.format(table="\n".join(lines))


def _line(row: Row, found: float | str | None) -> str:
    if row.absent:
        return f"| {row.quantity} | {row.tried} | not measured | {row.bound:.2g} | {_escaped(row.absent)} |"
    if row.bound is None:
        return f"| {row.quantity} | {row.tried} | refused | - | {_escaped(str(found))} |"
    words = ". ".join(text for text in (row.against, row.note) if text)
    return f"| {row.quantity} | {row.tried} | {float(found):.2g} | {row.bound:.2g} | {_escaped(words)} |"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
