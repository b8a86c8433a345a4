"""Evaluation of a trained system: a table of scores with one line per scene, and error maps."""

from __future__ import annotations

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
from kornia_tidy.files import csv_bytes, write_bytes
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.metrics import defocus_scores, depth_scores, image_scores, rmse
from kornia_tidy.reconstruction.reliability import sparsification_curve
from kornia_tidy.reconstruction.tasks import centre_crop, depth_logits, metres, normalised_inverse_depth, split_maps
from kornia_tidy.reconstruction.trained import TrainedSystem
from kornia_tidy.training.pictures import error_map
from kornia_tidy.training.scenes import Broken, SceneLoader

Row = dict[str, Any]
"""``scene`` (its number), ``name``, and scores by name."""

ABOUT_ROW = ("scene", "name")
SUREST = 0.7  # part of the pixels
REACH = 32.0  # in units of the near end: how far depth is scored in metres, if the range has no far end


class SceneResult(NamedTuple):
    """One scene as a trained system sees it; maps are (C, H, W)."""

    index: int
    name: str
    coded: Tensor
    estimate: dict[str, Tensor]
    truth: dict[str, Tensor]
    depth: Tensor
    """(1, H, W), as the data have it."""
    mask: Tensor
    """bool (1, H, W), True where depth is known."""
    deviation: Tensor | None = None
    """(1, H, W), standard deviation of the estimated depth, if the network tells it."""


@torch.no_grad()
def evaluate(
    system: TrainedSystem,
    scenes: Dataset,
    seed: int = 0,
    each: Callable[[SceneResult], None] | None = None,
) -> list[Row]:
    """Photograph scenes with a system's camera and score the estimates of its network.

    Args:
        system: camera and network, in eval mode.
        scenes: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere.
        seed: of the sensor's noise.
        each: called with each scene, for example to draw it or to show progress.

    Returns:
        One row per scene, with the scores of :func:`image_row` and :func:`depth_row`, as the task has them.

    Raises:
        ValueError: if a scene cannot be used; the message names it.
    """
    rows = []
    for batch in SceneLoader(scenes, 1, seed=seed, train=False):
        if isinstance(batch, Broken):
            raise ValueError(batch.reason)
        result = _reconstruct(system, batch)
        row: Row = {"scene": result.index, "name": result.name}
        if "depth" in result.estimate:
            row |= depth_row(system.optics.camera, result)
        if "image" in result.estimate:
            row |= image_row(result)
        rows.append(row)
        if each is not None:
            each(result)
    return rows


def image_row(result: SceneResult) -> dict[str, float]:
    """Return the scores of an all-in-focus image, which is not clipped to [0, 1].

    Returns:
        ``image_rmse``, ``image_psnr`` in dB, and ``image_ssim``; see :mod:`kornia_tidy.reconstruction.metrics`.
    """
    scores = image_scores(result.estimate["image"][None], result.truth["image"][None])
    return {f"image_{name}": float(value) for name, value in scores.items()}


def depth_row(camera: ThinLensCamera | DefocusRange, result: SceneResult) -> dict[str, float]:
    r"""Return the scores of a depth map where depth is known.

    Args:
        camera: the camera that took the capture.
        result: the scene.

    Returns:
        - ``depth_rmse``, of the normalised inverse depth in [0, 1] that the network estimates, and
          ``depth_rmse_radians``, of the defocus in radians: papers use both, and PhaseCam3D's radians are 20 times its
          normalised values.
        - ``depth_rmse_metres``, ``depth_abs_rel``, ``depth_log10`` and ``depth_delta1`` to ``depth_delta3``, of depth
          in metres, over the fraction ``depth_counted`` of all pixels. A camera of normalised disparity has none of
          these.
        - If the network tells how uncertain its depth is, ``depth_deviation``, the root mean square of the predicted
          standard deviations, which equals ``depth_rmse`` if the uncertainty is true on average, and
          ``depth_rmse_surest``, the RMSE over the 70 % of the pixels that it is surest of.

    Convention:
        Scores in metres count the pixels with a known depth within :func:`metric_range`, which excludes
        infinity. Estimates are clamped to this range.
    """
    estimate, truth, mask = result.estimate["depth"][None], result.truth["depth"][None], result.mask[None]
    lo, hi = camera.defocus_range
    unit, radians = defocus_scores(estimate, truth, mask, span=hi - lo).values()
    row = {"depth_rmse": unit, "depth_rmse_radians": radians}
    if result.deviation is not None:
        deviation = result.deviation[None]
        row["depth_deviation"] = rmse(deviation, torch.zeros_like(deviation), mask)
        row["depth_rmse_surest"] = _surest_rmse(estimate, deviation, truth, mask)
    if isinstance(camera, ThinLensCamera):
        near, far = metric_range(camera)
        depth = result.depth[None].to(estimate)
        counted = mask & (depth >= near) & (depth <= far)
        scores = depth_scores(metres(camera, estimate).clamp(near, far), depth, counted)
        scores["rmse_metres"] = scores.pop("rmse")
        row |= {f"depth_{name}": value for name, value in scores.items()}
        row["depth_counted"] = counted.float().mean()
    return {name: float(value) for name, value in row.items()}


def metric_range(camera: ThinLensCamera) -> tuple[float, float]:
    """Return the nearest and farthest depth that are scored in metres.

    They are the ends of the camera's range; if it has no far end, the farthest depth is 32 times the near end.

    Example:
        >>> metric_range(ThinLensCamera()), metric_range(ThinLensCamera(depth_range=(0.5, 4.0)))
        ((0.2975, 9.52), (0.5, 4.0))
    """
    near, far = camera.depth_range
    return near, REACH * near if math.isinf(far) else far


def mean_row(rows: Sequence[Row]) -> Row:
    """Return the mean of each score over the scenes in which it is not NaN.

    Example:
        >>> mean_row([{"scene": 0, "depth_rmse": 0.25}, {"scene": 1, "depth_rmse": 0.75}])
        {'depth_rmse': 0.5}
    """
    scores = {}
    for name in rows[0]:
        if name not in ABOUT_ROW:
            values = [row[name] for row in rows if not math.isnan(row[name])]
            scores[name] = sum(values) / len(values) if values else math.nan
    return scores


def write_table(folder: str | os.PathLike[str], rows: Sequence[Row], about: dict[str, Any]) -> None:
    """Write ``results.csv``, one line per scene, and ``summary.json`` with the means and ``about``."""
    write_bytes(Path(folder) / "results.csv", csv_bytes([rows[0], *([row[name] for name in rows[0]] for row in rows)]))
    summary = {**about, "scenes": len(rows), "mean": mean_row(rows)}
    write_bytes(Path(folder) / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())


def table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of a table of scores: mean, lowest and highest value over the scenes.

    Example:
        >>> for line in table([{"scene": 0, "depth_rmse": 0.25}, {"scene": 1, "depth_rmse": 0.75}]):
        ...     print(line)
        score                       mean    lowest   highest
        depth_rmse                0.5000    0.2500    0.7500
    """
    lines = [f"{'score':<20}{'mean':>12}{'lowest':>10}{'highest':>10}"]
    for name, mean in mean_row(rows).items():
        values = [row[name] for row in rows if not math.isnan(row[name])] or [math.nan]
        lines.append(f"{name:<20}{mean:>12.4f}{min(values):>10.4f}{max(values):>10.4f}")
    return lines


def draw_scene(folder: Path, result: SceneResult) -> None:
    """Write capture, estimates, true maps and errors (times 3) of a scene as PNG files."""
    pictures = {"coded": result.coded}
    for name, maps in result.estimate.items():
        known = result.mask if name == "depth" else torch.ones_like(result.mask)
        error = error_map(maps, result.truth[name]).where(known, 0)
        pictures |= {name: maps, f"{name}_truth": result.truth[name], f"{name}_error_x3": error}
    for name, picture in pictures.items():
        write_image(folder / f"scene_{result.index:04d}_{name}.png", picture)


def _reconstruct(system: TrainedSystem, batch: dict[str, Any]) -> SceneResult:
    noise = torch.Generator().manual_seed(batch["noise_seed"])
    sample = system.optics({"image": batch["image"], "depth": batch["depth"]}, generator=noise)
    coded, depth = sample["image"], sample["depth"]
    output = system.head(coded).float()
    maps, logits = split_maps(system.settings.task, output), depth_logits(system.settings.task, output)
    truth = {"image": sample["all_in_focus"][0], "depth": normalised_inverse_depth(system.optics.camera, depth)[0]}
    mask = centre_crop(batch["mask"], *coded.shape[-2:])[0]
    estimate = {name: m[0] for name, m in maps.items()}
    deviation = None if logits is None else depth_moments(logits)[1][0]
    return SceneResult(int(batch["index"]), batch["name"][0], coded[0], estimate, truth, depth[0], mask, deviation)


def _surest_rmse(estimate: Tensor, deviation: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    if not bool(mask.any()):
        return torch.tensor(torch.nan)
    return sparsification_curve(estimate, deviation, truth, mask, shares=(SUREST,))[0]
