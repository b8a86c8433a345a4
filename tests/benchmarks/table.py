"""The benchmarks as a table: `python -m tests.benchmarks.table outputs/benchmarks.json` prints Markdown."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

STATS = {"median": float, "iqr": float, "min": float, "max": float, "rounds": int}  # seconds
FACTS = {"size": int, "masks": int, "layers": int, "window": int, "wavelengths": int, "pupil": int, "threads": int}
TOP = {"machine_info": dict, "datetime": str, "benchmarks": list}


def read_benchmarks(path: str | Path) -> dict[str, Any]:
    """Read the JSON of pytest-benchmark, and check that it has the conditions of the measurement.

    Raises:
        ValueError: if a name is missing, or a value is of the wrong kind.
    """
    document = json.loads(Path(path).read_text())
    _check("the file", document, TOP)
    _check("machine_info", document["machine_info"], {"python_version": str, "cpu": dict})
    if not document["benchmarks"]:
        raise ValueError("the file has no benchmarks")
    for entry in document["benchmarks"]:
        _check("a benchmark", entry, {"name": str, "group": str, "stats": dict, "extra_info": dict})
        _check(f"stats of {entry['name']}", entry["stats"], STATS)
        _check(f"extra_info of {entry['name']}", entry["extra_info"], {**FACTS, "device": str})
        if not 0 < entry["stats"]["min"] <= entry["stats"]["median"] <= entry["stats"]["max"]:
            raise ValueError(f"stats of {entry['name']} are out of order: {entry['stats']}")
    return document


def markdown(document: dict[str, Any]) -> str:
    """Return one line a benchmark; facts that do not apply are left empty."""
    machine = document["machine_info"]
    threads = {entry["extra_info"]["threads"] for entry in document["benchmarks"]}
    lines = [
        f"{machine['cpu'].get('brand_raw', 'unknown processor')}, {'/'.join(map(str, sorted(threads)))} threads, "
        f"Python {machine['python_version']}, {document['datetime'][:10]}. Median and interquartile range.",
        "",
        "| benchmark | picture, px | K | layers | window | wavelengths | pupil samples | ms | ± |",
        "| --- |" + " ---: |" * 8,
    ]
    for entry in document["benchmarks"]:
        facts, stats = entry["extra_info"], entry["stats"]
        cells = [f"{entry['group']}: {entry['name'].removeprefix('test_').replace('_', ' ')}"]
        cells += [_side(facts["size"])] + [str(facts[name] or "") for name in ("masks", "layers")]
        cells += [_side(facts["window"]), str(facts["wavelengths"] or ""), _side(facts["pupil"])]
        cells += [f"{1e3 * stats['median']:.3g}", f"{1e3 * stats['iqr']:.2g}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _side(count: int) -> str:
    return f"{count}²" if count else ""


def _check(what: str, entry: Any, schema: dict[str, type]) -> None:
    if not isinstance(entry, dict):
        raise ValueError(f"{what} must be an object, got {type(entry).__name__}")
    for name, kind in schema.items():
        if name not in entry:
            raise ValueError(f"{what} has no {name}")
        if not isinstance(entry[name], (int, float) if kind is float else kind) or isinstance(entry[name], bool):
            raise ValueError(f"{name} of {what} must be {kind.__name__}, got {entry[name]!r}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="what pytest-benchmark has written")
    print(markdown(read_benchmarks(parser.parse_args().file)))
