"""Figure of a training run: loss over steps, validation score over steps, and the step at which it levels off."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.figures.style import ACCENT, BLUE, FAINT, INK, new_figure, open_chart, require_matplotlib, shown
from kornia_tidy.files import error_prefix, read_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE, LABEL, SMALL = 11, 9, 8  # pt
WIDTH, HEIGHT = 10.5, 4.2  # inches
TOLERANCE = 0.1  # dB
SMOOTHING = 50  # points of the loss, each the mean of equally many steps


def plateau_step(steps: Sequence[int], scores: Sequence[float], tolerance: float = TOLERANCE) -> int:
    """Return the first step with a score within a tolerance of the best score.

    Args:
        steps: at which the scores were taken, rising.
        scores: one for each step, larger is better.
        tolerance: in the unit of the scores.

    Returns:
        One of the steps; the last one if the score still rises by more than the tolerance.

    Raises:
        ValueError: if there are no scores, or their number is another one than that of the steps.

    Example:
        >>> plateau_step([100, 200, 300, 400], [25.0, 27.0, 27.95, 28.0])
        300
    """
    if not scores or len(scores) != len(steps):
        raise ValueError(f"a learning curve needs a score for each step, got {len(scores)} for {len(steps)} steps")
    return next(step for step, score in zip(steps, scores, strict=True) if score >= max(scores) - tolerance)


def draw_learning_curve(folder: str | os.PathLike[str]) -> Figure:
    """Draw the learning curve of a run from its ``training.csv`` and ``validation.csv``.

    The score is the PSNR of the image, or for depth only the RMSE in decibels, ``-20 log10(RMSE)``.

    Args:
        folder: of the run, as ``kornia-tidy train`` writes it.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1575 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        FileNotFoundError: if the folder has no logs.
        ValueError: if they have no lines, or are damaged.
    """
    losses, scores = (_rows(Path(folder) / name) for name in ("training.csv", "validation.csv"))
    if not losses or not scores:
        raise ValueError(f"there is nothing to draw: the run in {folder} has no validated epoch yet")
    require_matplotlib()
    with error_prefix(f"the logs of the run in {folder} are damaged", KeyError):
        numbers = np.array([[float(row["step"]), float(row["loss"])] for row in losses])
        name, decibels = _decibels(scores)
        steps = [int(row["step"]) for row in scores]
    return _drawn(Path(folder), numbers, name, decibels, steps)


def _drawn(folder: Path, losses: NDArray[np.float64], name: str, decibels: list[float], steps: list[int]) -> Figure:
    figure = new_figure(WIDTH, HEIGHT, layout=None)
    left, right = figure.add_axes((0.08, 0.14, 0.39, 0.66)), figure.add_axes((0.57, 0.14, 0.41, 0.66))
    parts = np.array_split(losses, SMOOTHING)
    means = np.array([part.mean(0) for part in parts if len(part)])
    left.plot(means[:, 0], means[:, 1], color=INK, linewidth=1.3)
    left.set_yscale("log" if bool((means[:, 1] > 0).all()) else "linear")  # a loss in decibels is negative
    plateau = plateau_step(steps, decibels)
    right.plot(steps, decibels, color=BLUE, linewidth=1.3, marker="o", markersize=3)
    right.axvline(plateau, color=ACCENT, linewidth=1, linestyle=(0, (4, 3)))
    for axes, what in ((left, "training loss"), (right, f"{name}, dB")):
        open_chart(axes, LABEL, xlabel="step", ylabel=what)
    figure.text(0.02, 0.92, f"Learning curve: {shown(folder.name)}", fontsize=TITLE, color=INK, weight="bold")
    level = f"within {TOLERANCE:g} dB of it at step {plateau:,} of {steps[-1]:,}"
    if plateau == steps[-1] and len(steps) > 1:
        level = "still rising at the end"
    figure.text(0.02, 0.86, f"best {name} {max(decibels):.2f} dB; {level}", fontsize=SMALL, color=FAINT)
    return figure


def _decibels(scores: list[dict[str, str]]) -> tuple[str, list[float]]:
    """Return the name and the values of the score of a validation log."""
    if "val_image_psnr" in scores[0]:
        return "validation PSNR", [float(row["val_image_psnr"]) for row in scores]
    name = "val_depth_rmse" if "val_depth_rmse" in scores[0] else "val_image_rmse"
    return "validation -20 log10(RMSE)", [-20 * math.log10(max(float(row[name]), 1e-9)) for row in scores]


def _rows(path: Path) -> list[dict[str, str]]:
    return [row for row in read_csv(path) if None not in row and None not in row.values()]
