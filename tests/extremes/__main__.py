"""Measure all extremes and write docs/record/extremes.md: ``python -m tests.extremes``, some minutes on one core."""

from __future__ import annotations

import argparse
import datetime as dt
import platform
from pathlib import Path

import torch
from tqdm import tqdm

from tests.extremes import growth
from tests.extremes.table import all_rows, measure, page

DOCS = Path(__file__).parents[2] / "docs" / "record"


def main() -> None:
    """Measure and write; rows beyond their bounds are told, and the page stays as it was."""
    parser = argparse.ArgumentParser(prog="python -m tests.extremes", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the rows of the test suite alone; nothing is written")
    parser.add_argument("--only", metavar="TEXT", default="", help="rows whose name has this text; nothing is written")
    arguments = parser.parse_args()
    rows = [row for row in all_rows() if arguments.only in row.name and not (arguments.quick and row.slow)]
    torch.set_num_threads(1)
    results, failures = {}, []
    with tqdm(total=len(rows), unit="row") as progress:
        for row in rows:
            progress.set_postfix_str(row.name)
            try:
                if not row.absent:
                    results[row.name] = measure(row)
            except (AssertionError, ValueError, TypeError) as error:
                failures.append(f"{row.name}: {error}")
            progress.update()
    for row in rows:
        if row.absent:
            print(f"not measured: {row.name}: {row.absent}")
    for name in failures:
        print(f"beyond its bound: {name}")
    if failures:
        raise SystemExit(1)
    if arguments.quick or arguments.only:
        for name, found in results.items():
            print(f"{name} | {found}")
        return
    with tqdm(total=sum(len(curve.values) for curve in growth.CURVES), unit="point") as progress:
        curves = growth.measured(progress)
    growth.draw(curves, DOCS / "images" / "extremes_growth.png")
    made = (
        f"Measured on {dt.datetime.now(tz=dt.UTC):%d %B %Y}, {platform.machine()}, "
        f"{torch.backends.cpu.get_cpu_capability()}, one thread, torch {torch.__version__.split('+')[0]}.\n"
        f"Errors differ in their digits between machines; the bounds hold on all."
    )
    (DOCS / "extremes.md").write_text(page(results, curves, made), encoding="utf-8")


if __name__ == "__main__":
    main()
