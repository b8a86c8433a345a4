"""Runner of the paper's experiments: trials that resume, with a table, a figure and the conditions they were run under.

Each experiment is a module with a description of its trials and a function that measures one. A trial is appended to
``results/NAME-SCALE.csv`` as soon as it is measured; a run with the same settings goes on where it stopped.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from kornia_tidy.files import write_bytes

SCALES = ("smoke", "cpu", "gpu", "paper")
HERE = Path(__file__).parent
RESULTS = HERE / "results"
ABOUT = ("settings", "date", "commit", "machine")  # columns that say how a trial was measured

Trial = Mapping[str, str]
"""What distinguishes a trial, by name; the seed is one of them."""
Row = dict[str, str]
"""A trial with its scores as text, as the table holds them."""


@dataclass(frozen=True)
class Experiment:
    """One of the paper's experiments.

    Args:
        name: of the module and of the files of results.
        title: heading of its section.
        trials: function from the scale to the trials, the most wanted first.
        measure: function from a trial and the scale to its scores by name; with ``together``, from several trials to
            the scores of each.
        table: function from rows and scale to the section's text, in Markdown.
        settings: function from the scale to all that results depend on, in words.
        draw: function from rows and a path to a figure, if it has one.
        together: number of trials that are measured at once, by scale. None: one after the other.
    """

    name: str
    title: str
    trials: Callable[[str], Sequence[Trial]]
    measure: Callable[..., Any]
    table: Callable[[Sequence[Row], str], str]
    settings: Callable[[str], str]
    draw: Callable[[Sequence[Row], Path], None] | None = None
    together: Mapping[str, int] | None = None

    def measure_all(self, trials: Sequence[Trial], scale: str) -> Sequence[Mapping[str, float | str]]:
        """Return the scores of each trial."""
        if self.together is not None:
            return self.measure(trials, scale)
        return [self.measure(trial, scale) for trial in trials]


def main(experiment: Experiment, about: str, arguments: Sequence[str] | None = None) -> list[Row]:
    """Run an experiment from the command line and return its rows."""
    options = parse(experiment, about, arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    commit()  # of the code that is loaded now
    rows = run(experiment, options.scale, folder, options.most)
    write_section(experiment, rows, options.scale, folder)
    print(experiment.table(rows, options.scale))
    return rows


def parse(experiment: Experiment, about: str, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m examples.paper.{experiment.name}",
        description=about,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--scale", choices=SCALES, default="smoke",
        help="smoke: seconds, shows that it runs; cpu: minutes to hours; gpu: an hour or more on a GPU; paper: the "
        "paper's own extent, days on a GPU (default: smoke)",
    )  # fmt: skip
    parser.add_argument("--most", type=int, help="stop after so many new trials; a later run goes on")
    parser.add_argument(
        "--output", default=str(RESULTS), metavar="FOLDER", help="of CSV, figure and table (default: results/ beside)"
    )
    parser.add_argument("--threads", type=int, default=1, help="of torch; 0 leaves them as they are (default: 1)")
    return parser.parse_args(arguments)


def run(experiment: Experiment, scale: str, folder: Path, most: int | None = None) -> list[Row]:
    """Measure the trials that the table does not hold yet, and return all rows in the order of the trials.

    Raises:
        ValueError: if the table holds trials of other settings.
    """
    path = folder / f"{experiment.name}-{scale}.csv"
    settings = hashlib.sha256(experiment.settings(scale).encode()).hexdigest()[:12]
    rows = read_rows(path)
    if any(row["settings"] != settings for row in rows):
        raise ValueError(f"{path} holds trials of other settings: remove it, or choose another --output")
    trials = [dict(trial) for trial in experiment.trials(scale)]
    known = [trial_of(row, trials) for row in rows]
    todo = [trial for trial in trials if trial not in known][:most]
    size = 1 if experiment.together is None else experiment.together[scale]
    bar = tqdm(total=len(todo), desc=experiment.name, leave=False, disable=None)
    for start in range(0, len(todo), size):
        group = todo[start : start + size]
        bar.set_postfix_str(", ".join(group[0].values()))
        about = dict(zip(ABOUT, (settings, f"{datetime.now(UTC):%Y-%m-%d}", commit(), machine()), strict=True))
        for trial, scores in zip(group, experiment.measure_all(group, scale), strict=True):
            rows.append({**trial, **{name: as_text(value) for name, value in scores.items()}, **about})
        write_rows(path, rows)
        bar.update(len(group))
    places = {tuple(trial.items()): place for place, trial in enumerate(trials)}
    rows.sort(key=lambda row: places.get(tuple(trial_of(row, trials).items()), len(places)))
    if rows:
        write_rows(path, rows)
    return rows


def trial_of(row: Row, trials: Sequence[Trial]) -> dict[str, str | None]:
    """Return what distinguishes the trial of a row, by the names that the trials have."""
    return {name: row.get(name) for name in trials[0]}


def as_text(value: float | str) -> str:
    """Return a score as text, with six digits."""
    return value if isinstance(value, str) else f"{value:.6g}"


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a table of results; none if there is no file."""
    if not path.exists():
        return []
    return [
        {name: value for name, value in row.items() if value}
        for row in csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
    ]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a table of results whole, so that an interruption leaves the old one or the new one."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def write_section(experiment: Experiment, rows: Sequence[Row], scale: str, folder: Path) -> None:
    """Write the figure and the section of the README, with the conditions of the trials."""
    name = f"{experiment.name}-{scale}"
    lines = [f"## {experiment.title}", "", experiment.table(rows, scale), ""]
    if experiment.draw is not None:
        experiment.draw(rows, folder / f"{name}.png")
        lines += [f"![{experiment.title}](results/{name}.png)", ""]
    dates, commits, machines = (sorted({row[column] for row in rows}) for column in ABOUT[1:])
    planned = len(experiment.trials(scale))
    lines += [
        f"`python -m examples.paper.{experiment.name} --scale {scale}`: {len(rows)} of {planned} trials, "
        f"{', '.join(dates)}, commit {', '.join(commits)}, {'; '.join(machines)}. {experiment.settings(scale)}",
        "",
    ]
    write_bytes(folder / f"{name}.md", "\n".join(lines).encode())


@lru_cache
def commit() -> str:
    """Return the abbreviated commit of the checkout when it is first asked for, with a plus sign if files differ."""
    try:
        told = subprocess.run(  # noqa: S603
            ["git", "-C", str(HERE), "describe", "--always", "--dirty=+", "--exclude=*"],  # noqa: S607
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return told.stdout.strip()


def machine() -> str:
    """Return processor or GPU, threads and the version of torch."""
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}"
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{os.cpu_count()} cores of {model}, {torch.get_num_threads()} thread, PyTorch {torch.__version__}"


if __name__ == "__main__":
    sys.exit("run one of the experiments, such as: python -m examples.paper.sequence_length --scale smoke")
