"""Files of a sweep: JSON with its conditions, and a table in Markdown."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from kornia_tidy.design.tradeoff.conditions import Conditions
from kornia_tidy.design.tradeoff.measure import TradeRow, pareto
from kornia_tidy.files import write_bytes

FORMAT = "kornia_tidy.trade/1"


@dataclass(frozen=True)
class TradeRun:
    """Rows of a sweep and their common conditions."""

    conditions: Conditions
    rows: tuple[TradeRow, ...]


def write_trade(folder: str | os.PathLike[str], run: TradeRun) -> None:
    """Write a run as ``trade.json``, atomically.

    Raises:
        FileNotFoundError: if the folder does not exist.
    """
    document = {"format": FORMAT, **asdict(run)}
    write_bytes(Path(folder) / "trade.json", (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def markdown(rows: Sequence[TradeRow]) -> str:
    """Return the rows as a table in Markdown, with the Pareto front of time and error in bold.

    Example:
        >>> print(markdown([]).splitlines()[0])
        | knob | value | layers | window | RMSE | max error | capture, ms | cached bank, ms | memory, MiB |
    """
    training = any(row.training_seconds is not None for row in rows)
    names = ["knob", "value", "layers", "window", "RMSE", "max error", "capture, ms", "cached bank, ms"]
    names += ["with gradients, ms"] if training else []
    names += ["memory, MiB"] + (["with gradients, MiB"] if training else [])
    lines = [f"| {' | '.join(names)} |", f"|{' --- |' * 2}{' ---: |' * (len(names) - 2)}"]
    front = pareto(rows)
    for row in rows:
        cells = [row.knob, value_in_words(row), str(row.layers), str(row.window)]
        cells += [error_in_words(row.rmse), error_in_words(row.max_error)]
        cells += [_milliseconds(row.capture_seconds, row.capture_spread)]
        cells += [_milliseconds(row.render_seconds, row.render_spread)]
        cells += [_milliseconds(row.training_seconds, row.training_spread)] if training else []
        cells += [_mebibytes(row.capture_bytes)] + ([_mebibytes(row.training_bytes)] if training else [])
        if row in front:
            cells[1] = f"**{cells[1]}**"
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def value_in_words(row: TradeRow) -> str:
    """Format the value of the swept setting of a row.

    Args:
        row: one row of a sweep.
    """
    if row.value is None:
        return f"{row.window}, measured"
    if isinstance(row.value, bool):
        return "on" if row.value else "off"
    return f"{row.value:g}" if isinstance(row.value, float) else str(row.value)


def error_in_words(error: float) -> str:
    """Format an error with two significant digits.

    Example:
        >>> error_in_words(0.01234), error_in_words(0.0000321), error_in_words(0.0)
        ('0.012', '3.2e-05', '0')
    """
    return "0" if error == 0 else f"{error:.2g}"


def _milliseconds(median: float | None, spread: float | None) -> str:
    if median is None or spread is None:
        return ""
    digits = max(0, 2 - len(f"{int(1e3 * median)}"))
    return f"{1e3 * median:.{digits}f} ± {1e3 * spread:.{digits}f}"


def _mebibytes(count: int | None) -> str:
    return "" if count is None else f"{count / 2**20:.0f}"
