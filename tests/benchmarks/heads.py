"""Trains the small heads that the library ships, and compares five masks with one and with none.

Every system is trained with the same scenes, network and steps, all of which ``SETTINGS`` decides; only the optics
differ. None of the scenes of the tables is ever trained on.

- ``python -m tests.benchmarks.heads train FOLDER``: each system in a folder of its own; goes on where it stopped. Two
  such commands may share the work (``--tasks``, ``--masks``, ``--seeds``). ``--sigma``, ``--start`` and ``--epochs``
  change the noise, the first masks and the steps of all: for a table of their own, in a folder of their own.
- ``... score FOLDER``: each system on new dead leaves and on the real scenes, where these are on the machine.
- ``... table FOLDER``: prints the table, means over scenes and their spread over seeds.
- ``... ship FOLDER``: of each kind that the library names, the system with the lowest validation loss.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import statistics
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Dataset

from kornia_tidy.choices import STARTS
from kornia_tidy.data.dead_leaves import DeadLeaves
from kornia_tidy.data.patches import central_crop
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import ship
from kornia_tidy.reconstruction.tasks import stretched
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.callbacks import BEST
from kornia_tidy.training.evaluation import SceneResult, evaluate, mean_row
from kornia_tidy.training.run import train
from kornia_tidy.training.settings import TrainingSettings
from tests.scenes import ENTRIES, load_scene

FOLDER = Path(__file__).parents[2] / "examples/paper/systems"  # of the systems that earlier versions shipped
SETTINGS = TrainingSettings(
    # Shot noise at a fifth of full scale, of 57,000 electrons: pixels of 8 um with the well of an industrial sensor's
    # 10,500 electrons in 3.45 um.
    sigma=0.002,
    head="attention-unet", width=8, residual=True, size=128, scenes=480, validation_scenes=24, batch=6, lr=2e-3,
    lr_metres=6e-8, schedule="cosine", ema=0.99, precision="bf16-mixed",
)  # fmt: skip
EDOF = SETTINGS.replace(task="edof", refocus=5, start="focal sweep", design=120, epochs=10)
# Depth is harder to learn: masks that show it begin as Fisher masks.
JOINT = SETTINGS.replace(task="joint", refocus=9, start="like fishers", epochs=15, depth_weight=0.3)
TASKS = {"edof": EDOF, "joint": JOINT}
MASKS = {5: "K = 5", 1: "K = 1", 0: "Fresnel lens"}
SEEDS = (0, 1, 2)
LEAVES, LEAVES_SIZE, LEAVES_SEED = 32, 256, 987654321  # the scenes of no training seed
LARGEST = 512  # pixels; of real scenes the middle
SCORES = {
    "capture_psnr": "capture, dB",
    "image_psnr": "all in focus, dB",
    "image_ssim": "SSIM",
    "depth_rmse": "depth RMSE (of the range)",
    "depth_rmse_radians": "(rad)",
}


class RealScenes(Dataset[dict[str, Any]]):
    """The middles of the real scenes, their depths stretched over a camera's range."""

    def __init__(self, camera: ThinLensCamera) -> None:
        self.names, self.camera = sorted(ENTRIES), camera

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> dict[str, Any]:
        image, depth, valid = load_scene(self.names[index])
        depth = stretched(depth, valid, self.camera)
        sample = {"image": image.expand(3, -1, -1), "depth": depth, "mask": valid}
        size = tuple(min(LARGEST, side) for side in image.shape[-2:])
        return {**central_crop(sample, (size[0], size[1])), "index": index, "name": self.names[index]}


def folder_of(root: Path, task: str, masks: int, seed: int) -> Path:
    """Return where a system is trained."""
    return root / f"{task}-{masks}-seed{seed}"


def train_all(root: Path, tasks: list[str], masks: list[int], seeds: list[int], **changed: Any) -> None:
    """Train all systems that have no checkpoint yet, with some settings changed for all."""
    for seed in seeds:
        for task in tasks:
            for number in masks:
                folder = folder_of(root, task, number, seed)
                print(folder.name, flush=True)
                settings = TASKS[task].replace(masks=number, seed=seed, **changed)
                train(settings, folder, resume=True, progress=True)


def is_trained(folder: Path) -> bool:
    """Whether all epochs have been validated."""
    log = folder / "validation.csv"
    return log.exists() and len(_rows(log)) >= TrainingSettings.read(folder / "settings.json").epochs


def score(folder: Path) -> dict[str, dict[str, float]]:
    """Return the mean scores of a system on each set of scenes."""
    system = load_trained(folder / BEST)
    camera = system.optics.camera
    assert isinstance(camera, ThinLensCamera)
    leaves = DeadLeaves(LEAVES, LEAVES_SIZE, LEAVES_SIZE, depth_range=camera.depth_range, seed=LEAVES_SEED)
    sets: dict[str, Dataset[Any]] = {"dead leaves": leaves, **({"real scenes": RealScenes(camera)} if ENTRIES else {})}
    scores = {}
    for name, scenes in sets.items():
        captures: list[float] = []

        def note(result: SceneResult, captures: list[float] = captures) -> None:
            captures.append(float(psnr(result.coded[None], result.truth["image"][None])))

        rows = evaluate(system, scenes, each=note)
        scores[name] = {"scenes": len(rows), "capture_psnr": statistics.fmean(captures), **mean_row(rows)}
    return scores


def score_all(root: Path) -> None:
    """Score all trained systems without scores."""
    for folder in sorted(root.iterdir()):
        if is_trained(folder) and not (folder / "scores.json").exists():
            scores = score(folder)
            print(folder.name, {name: round(values["capture_psnr"], 2) for name, values in scores.items()}, flush=True)
            write_bytes(folder / "scores.json", (json.dumps(scores, indent=2) + "\n").encode())


def summary(root: Path) -> list[dict[str, Any]]:
    """Return a row for each task, set of scenes and optics: the mean and spread of each score over the seeds."""
    rows = []
    for task in TASKS:
        for masks, name in MASKS.items():
            files = [folder_of(root, task, masks, seed) / "scores.json" for seed in SEEDS]
            runs = [json.loads(file.read_text()) for file in files if file.exists()]
            for scenes in runs[0] if runs else ():
                row: dict[str, Any] = {"task": task, "scenes": scenes, "optics": name, "seeds": len(runs)}
                for key in SCORES:
                    values = [run[scenes][key] for run in runs if key in run[scenes]]
                    if values:
                        row[key] = (statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else 0.0)
                rows.append(row)
    return rows


def table(root: Path) -> str:
    """Return the summary as Markdown."""
    lines = [f"| task | scenes | optics | {' | '.join(SCORES.values())} |", "|---" * (3 + len(SCORES)) + "|"]
    for row in sorted(summary(root), key=lambda row: (row["task"], row["scenes"])):
        cells = []
        for key in SCORES:
            digits = 2 if key.endswith(("psnr", "radians")) else 3
            cells.append("{:.{d}f} ± {:.{d}f}".format(*row[key], d=digits) if key in row else "")
        lines.append(f"| {row['task']} | {row['scenes']} | {row['optics']} | {' | '.join(cells)} |")
    return "\n".join(lines)


def ship_all(root: Path) -> None:
    """Put the best systems into the library, and beside them how they came about."""
    systems, settings = {}, {}
    for task, masks in ((task, masks) for task in TASKS for masks in MASKS):
        name, runs = f"{task}-{masks}", {}
        for seed in SEEDS:
            folder = folder_of(root, task, masks, seed)
            if is_trained(folder):
                runs[folder] = min(float(row["val_loss"]) for row in _rows(folder / "validation.csv"))
        best = min(runs, key=lambda folder: runs[folder])
        ship(best / BEST, FOLDER / f"{name}.safetensors")
        # Of the task: masks and seeds are the systems' own.
        settings.setdefault(task, TrainingSettings.read(best / "settings.json").replace(masks=5, seed=0).as_dict())
        seconds = [float(row["seconds_a_step"]) for row in _rows(best / "training.csv")]
        systems[name] = {
            "seed": int(best.name[-1]),
            "seeds tried": len(runs),
            "validation": _rows(best / "validation.csv"),
            "minutes": round(len(seconds) * statistics.median(seconds) / 60, 1),
            "scores": json.loads((best / "scores.json").read_text()),
        }
    about = {
        "command": "python -m tests.benchmarks.heads train FOLDER",
        "date": datetime.now(UTC).date().isoformat(),
        "commit": subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], text=True).strip(),
        "machine": f"{platform.machine()}, one thread a run, {os.cpu_count()} cores shared",
        "torch": torch.__version__,
        "settings": settings,
        "systems": systems,
    }
    write_bytes(FOLDER / "heads.json", (json.dumps(about, indent=1) + "\n").encode())


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("train", "score", "table", "ship"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--masks", nargs="+", type=int, choices=MASKS, default=list(MASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--sigma", type=float)
    parser.add_argument("--start", choices=STARTS)
    parser.add_argument("--epochs", type=int)
    args = parser.parse_args()
    if args.command == "train":
        changed = {name: value for name in ("sigma", "start", "epochs") if (value := getattr(args, name)) is not None}
        train_all(args.folder, args.tasks, args.masks, args.seeds, **changed)
    elif args.command == "score":
        score_all(args.folder)
    elif args.command == "table":
        print(table(args.folder))
    else:
        ship_all(args.folder)


if __name__ == "__main__":
    sys.exit(main())
