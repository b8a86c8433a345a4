"""Files of a sweep: JSON with its conditions, CSV for spreadsheets, and a table in Markdown."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from kornia_tidy.design.tradeoff.conditions import Conditions
from kornia_tidy.design.tradeoff.measure import TradeRow, pareto
from kornia_tidy.design.tradeoff.sweep_settings import PLAN, PRESET
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.files import parse_json, read_bytes, read_text, write_bytes

FORMAT = "kornia_tidy.trade/1"
_KNOB = "fidelity."  # prefix of the CSV columns with the settings of the fidelity


@dataclass(frozen=True)
class TradeRun:
    """Rows of a sweep and their common conditions."""

    conditions: Conditions
    rows: tuple[TradeRow, ...]


def write_json(path: str | os.PathLike[str], run: TradeRun) -> None:
    """Write a sweep as JSON, atomically.

    Raises:
        FileNotFoundError: if the folder does not exist.
    """
    document = {
        "format": FORMAT,
        "conditions": asdict(run.conditions),
        "rows": [asdict(row) for row in run.rows],
    }
    write_bytes(path, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: str | os.PathLike[str]) -> TradeRun:
    """Read a sweep written by :func:`write_json`, with a check of every name and type.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a sweep, or has the schema of another version.
    """
    data = read_bytes(path)
    try:
        document = parse_json(data)
        _check_names("the file", document, {"format", "conditions", "rows"})
        if document["format"] != FORMAT:
            raise ValueError(f"its format is {document['format']!r}, not {FORMAT!r}")
        if not isinstance(document["rows"], list):
            raise ValueError("rows must be a list")
        conditions = Conditions(**_checked("conditions", Conditions, document["conditions"]))
        return TradeRun(conditions, tuple(_row(entry) for entry in document["rows"]))
    except ValueError as error:  # includes errors of JSON and Unicode
        raise ValueError(f"{path} is not a readable sweep: {error!s:.500}") from None


def write_csv(path: str | os.PathLike[str], rows: Iterable[TradeRow]) -> None:
    """Write the rows as CSV, atomically; None becomes an empty cell.

    Raises:
        FileNotFoundError: if the folder does not exist.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, _columns(), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        entry = asdict(row)
        entry |= {_KNOB + name: value for name, value in entry.pop("fidelity").items()}
        writer.writerow({name: "" if value is None else value for name, value in entry.items()})
    write_bytes(path, text.getvalue().encode())


def read_csv(path: str | os.PathLike[str]) -> list[TradeRow]:
    """Read rows written by :func:`write_csv`.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if its columns or values are not those of a sweep.
    """
    text = read_text(path)
    try:
        reader = csv.DictReader(io.StringIO(text))
        _check_names("the header", dict.fromkeys(reader.fieldnames or ()), set(_columns()))
        return [_row(_typed(cells)) for cells in map(_whole, reader)]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path} is not a readable sweep: {error!s:.500}") from None


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


# ------------------------------------------------------------------ the schema: names and types of the dataclasses


def _row(entry: Any) -> TradeRow:
    values = _checked("a row", TradeRow, entry)
    knobs = _checked("a row's fidelity", Fidelity, values["fidelity"])
    whole: dict[str, Any] = {**values, "fidelity": Fidelity(**knobs)}
    row = TradeRow(**whole)
    if row.knob not in (PRESET, PLAN) and row.value != knobs.get(row.knob):
        raise ValueError(f"a row says {row.knob} = {row.value!r}, its fidelity has {knobs.get(row.knob)!r}")
    return row


def _checked(what: str, kind: type, entry: Any) -> dict[str, Any]:
    """Return an entry of JSON after a check of its names and types against a dataclass."""
    hints = get_type_hints(kind)
    _check_names(what, entry, set(hints))
    for name, value in entry.items():
        allowed = get_args(hints[name]) or (hints[name],)
        if Fidelity in allowed:
            allowed = (dict,)
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed and name != "value"):
            if float in allowed and type(value) is int:  # other programs write 2.0 as 2
                continue
            raise ValueError(f"{name} in {what} must be {hints[name]}, got {value!r:.80}")
    return entry


def _check_names(what: str, entry: Any, names: set[str]) -> None:
    if not isinstance(entry, dict):
        raise ValueError(f"{what} must hold {', '.join(sorted(names))}, got {type(entry).__name__}")
    if wrong := names ^ set(entry):
        kinds = [f"{'no' if name in names else 'an unknown'} {name}" for name in sorted(map(str, wrong))]
        raise ValueError(f"{what} has {', '.join(kinds):.400}")


def _columns() -> list[str]:
    plain = [field.name for field in fields(TradeRow) if field.name != "fidelity"]
    return plain + [_KNOB + field.name for field in fields(Fidelity)]


def _whole(cells: dict[str, str]) -> dict[str, str]:
    """Return a line of CSV that has a cell for each column, and no more."""
    if None in cells or None in cells.values():
        raise ValueError("a line has more or fewer cells than the header")
    return cells


def _typed(cells: dict[str, str]) -> dict[str, Any]:
    """Convert the cells of a CSV row to the types of their columns."""
    knobs = get_type_hints(Fidelity)
    hints = {**get_type_hints(TradeRow), **{_KNOB + name: hint for name, hint in knobs.items()}}
    hints["value"] = {**knobs, PLAN: float}.get(cells["knob"], str)
    entry: dict[str, Any] = {name: _parsed(text, hints[name]) for name, text in cells.items()}
    entry["fidelity"] = {name: entry.pop(_KNOB + name) for name in knobs}
    return entry


def _parsed(text: str, hint: Any) -> Any:
    kinds = get_args(hint) or (hint,)
    if text == "" and type(None) in kinds:
        return None
    if bool in kinds:
        if text not in ("True", "False"):
            raise ValueError(f"expected True or False, got {text!r:.80}")
        return text == "True"
    for kind in (int, float):
        if kind in kinds:
            return kind(text)
    return text


def known_rows(folder: str | os.PathLike[str], conditions: Conditions) -> tuple[tuple[TradeRow, ...], str]:
    """Return the rows of an earlier run in a folder that are still valid, and a remark about them.

    Raises:
        ValueError: if its ``trade.json`` does not hold a sweep.
    """
    path = Path(folder) / "trade.json"
    if not path.exists():
        return (), ""
    earlier = read_json(path)
    if earlier.conditions.same(conditions):
        return earlier.rows, f"; {path} goes on"
    return (), f"; {path} is of another scene, machine or code and will be replaced"


def rows_beside(known: Sequence[TradeRow], rows: Sequence[TradeRow]) -> list[TradeRow]:
    """Return the known rows that others do not replace."""
    done = {(row.knob, row.value, row.fidelity) for row in rows}
    return [row for row in known if (row.knob, row.value, row.fidelity) not in done]


def write_trade(folder: str | os.PathLike[str], run: TradeRun) -> None:
    """Write a run as ``trade.json`` and ``trade.csv``, atomically."""
    write_json(Path(folder) / "trade.json", run)
    write_csv(Path(folder) / "trade.csv", run.rows)
