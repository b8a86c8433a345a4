"""Ships networks of ``kornia-tidy train --learn network``.

``python -m tests.benchmarks.ship_networks NAME=FOLDER ...``
Each is scored on new dead leaves and on the real scenes, where these are on the machine, and put into the library with
the commands that made it, which FOLDER/commands.txt holds. FOLDER/machine.txt tells where it learnt, if not here.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import statistics
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from kornia_tidy.files import write_bytes
from kornia_tidy.reconstruction.pretrained import FOLDER, PRETRAINED, about_pretrained
from kornia_tidy.training.callbacks import BEST
from kornia_tidy.training.settings import TrainingSettings
from tests.benchmarks.shipped_files import ship
from tests.benchmarks.system_scores import score

COMMANDS, MACHINE, SCORES = "commands.txt", "machine.txt", "scores.json"


def record(folder: Path) -> dict[str, Any]:
    """Return what heads.json tells of a run: commands, settings, minutes, validation, scores, machine and date."""
    rows = {name: list(csv.DictReader((folder / f"{name}.csv").open())) for name in ("training", "validation")}
    settings = TrainingSettings.read(folder / "settings.json")
    seconds = [float(row["seconds_a_step"]) for row in rows["training"]]
    return {
        "command": (folder / COMMANDS).read_text().strip(),
        "date": datetime.now(UTC).date().isoformat(),
        "commit": subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], text=True).strip(),
        "machine": machine_of(folder),
        "torch": torch.__version__,
        "seed": settings.seed,
        "seeds tried": 1,
        "settings": {**settings.as_dict(), "root": None},  # a place on one machine
        "validation": rows["validation"],
        "minutes": round(int(rows["training"][-1]["step"]) * statistics.median(seconds) / 60, 1),
        "scores": scores_of(folder),
    }


def machine_of(folder: Path) -> str:
    """Return where a run learnt: what its folder says, or this machine."""
    path = folder / MACHINE
    here = f"{platform.machine()}, one thread a run, {os.cpu_count()} cores shared"
    return path.read_text().strip() if path.exists() else here


def scores_of(folder: Path) -> dict[str, dict[str, float]]:
    """Return the scores of a run, which are computed once and kept in its folder."""
    path = folder / SCORES
    if not path.exists():
        write_bytes(path, (json.dumps(score(folder), indent=1) + "\n").encode())
    return json.loads(path.read_text())


def main() -> None:
    """Score and ship each folder."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.ship_networks", description=__doc__)
    parser.add_argument("systems", nargs="+", metavar="NAME=FOLDER", help=f"NAME is one of {', '.join(PRETRAINED)}")
    for entry in parser.parse_args().systems:
        name, _, folder = entry.partition("=")
        if name not in PRETRAINED or not (Path(folder) / COMMANDS).is_file():
            parser.error(f"{entry}: NAME must be one of {', '.join(PRETRAINED)}, and FOLDER must hold {COMMANDS}")
        about = about_pretrained()
        about["systems"][name] = record(Path(folder))
        ship(Path(folder) / BEST, FOLDER / f"{name}.safetensors")
        write_bytes(FOLDER / "heads.json", (json.dumps(about, indent=1) + "\n").encode())
        print(name, about["systems"][name]["scores"], flush=True)


if __name__ == "__main__":
    main()
