"""How well a trained system does: a table with a line for each scene, and maps of where it errs."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kornia_tidy.data.image_files import write_image
from kornia_tidy.files import write_bytes
from kornia_tidy.training.pictures import error_map
from kornia_tidy.training.scenes import Broken, SceneLoader
from kornia_tidy.training.tasks import centre_crop, image_rmse, nearness, split_maps
from kornia_tidy.training.trained import TrainedSystem

Row = dict[str, float]


class Looked(NamedTuple):
    """One scene as a trained system sees it; maps are (C, H, W)."""

    index: int
    coded: Tensor
    estimate: dict[str, Tensor]
    truth: dict[str, Tensor]
    mask: Tensor


@torch.no_grad()
def evaluate(
    system: TrainedSystem,
    scenes: Dataset,
    seed: int = 0,
    each: Callable[[Looked], None] | None = None,
) -> list[Row]:
    """Let a system photograph scenes and estimate them.

    Args:
        system: camera and network, in eval mode.
        scenes: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere.
        seed: of the sensor's noise.
        each: is shown every scene, to draw it or to say how far things are.

    Returns:
        One row a scene: ``scene``, and for each map its root mean squared error, of an image in [0, 1] or of nearness
        in [0, 1]; for images their peak signal-to-noise ratio in dB too. Depth is compared where it is known.

    Raises:
        ValueError: if a scene is broken; it is named.
    """
    rows = []
    for batch in SceneLoader(scenes, 1, seed=seed, train=False):
        if isinstance(batch, Broken):
            raise ValueError(batch.reason)
        looked = _look(system, batch)
        row: Row = {"scene": looked.index}
        for name, maps in looked.estimate.items():
            known = looked.mask[None] if name == "depth" else None
            row[f"{name}_rmse"] = float(image_rmse(maps[None], looked.truth[name][None], known))
            if name == "image":
                row["image_psnr"] = -20 * math.log10(max(row["image_rmse"], 1e-12))
        rows.append(row)
        if each is not None:
            each(looked)
    return rows


def mean_row(rows: Sequence[Row]) -> Row:
    """Return the mean of each score over the scenes that have it.

    Example:
        >>> mean_row([{"scene": 0, "depth_rmse": 0.25}, {"scene": 1, "depth_rmse": 0.75}])
        {'depth_rmse': 0.5}
    """
    scores = {}
    for name in rows[0]:
        values = [row[name] for row in rows if not math.isnan(row[name])]
        if name != "scene":
            scores[name] = sum(values) / len(values) if values else math.nan
    return scores


def write_table(folder: str | os.PathLike[str], rows: Sequence[Row], about: dict[str, Any]) -> None:
    """Write ``results.csv``, a line a scene, and ``summary.json``: the means and what was evaluated."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(Path(folder) / "results.csv", text.getvalue().encode())
    summary = {**about, "scenes": len(rows), "mean": mean_row(rows)}
    write_bytes(Path(folder) / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())


def draw_scene(folder: Path, looked: Looked) -> None:
    """Write a scene's capture, estimates, truths and errors (times 3) as PNG files."""
    pictures = {"coded": looked.coded}
    for name, maps in looked.estimate.items():
        known = looked.mask if name == "depth" else torch.ones_like(looked.mask)
        error = error_map(maps, looked.truth[name]).where(known, 0)
        pictures |= {name: maps, f"{name}_truth": looked.truth[name], f"{name}_error_x3": error}
    for name, picture in pictures.items():
        write_image(folder / f"scene_{looked.index:04d}_{name}.png", picture)


def _look(system: TrainedSystem, batch: dict[str, Any]) -> Looked:
    noise = torch.Generator().manual_seed(batch["noise_seed"])
    sample = system.optics({"image": batch["image"], "depth": batch["depth"]}, generator=noise)
    coded, depth = sample["image"], sample["depth"]
    maps = split_maps(system.settings.task, system.head(coded).float())
    truth = {"image": sample["all_in_focus"][0], "depth": nearness(system.optics.camera, depth)[0]}
    mask = centre_crop(batch["mask"], *coded.shape[-2:])[0]
    return Looked(int(batch["index"]), coded[0], {name: m[0] for name, m in maps.items()}, truth, mask)
