"""Experiment 2, all-in-focus without a network: how much does the best capture depend on where the masks begin?

    python -m examples.paper.point_psf --scale smoke
    python -m examples.paper.point_psf --scale cpu          100 starts of each length: some minutes
    python -m examples.paper.point_psf --scale paper        1,000 of each, the paper's own extent: an hour of one core

Sequences of masks are optimised from noise until their PSFs, averaged over the sequence, are as close as they get to
the unit impulse at 21 depths. The score is the error of captures, against the scenes in focus everywhere.

What the paper leaves open, and how it is done here: light of 530 nm; heights follow Adam from steps of 6e-8 m; a start
whose loss fell by less than a ten-thousandth in 20 steps continues with half the step, and has converged after the
fifth time. Four scenes are painted, with depth over the whole range, and composed layer by layer (gather) in linear
light.

Source: Shah et al., TiDy-PSFs (ICCV 2023), the experiment on extended depth of field without a network.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import torch
from kornia.color import rgb_to_linear_rgb
from matplotlib.figure import Figure
from torch import Tensor

from examples.paper.report import grid
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.sequences import PSI, RULE, first_phase, impulse, learn, psfs_of
from kornia_tidy import ThinLensCamera
from kornia_tidy.data import photographic_leaves
from kornia_tidy.psf.paper import PAPER_SIZE

LENGTHS = (1, 2, 3, 5, 4, 8, 16)  # the lengths that are wanted most come first
STARTS = {"smoke": 4, "cpu": 100, "gpu": 1000, "paper": 1000}
TOGETHER = {"smoke": 2, "cpu": 50, "gpu": 1000, "paper": 50}  # starts in a batch: 50 fit the caches of a processor
STEPS = {"smoke": 20, "cpu": 600, "gpu": 600, "paper": 600}  # at most
SCENES, SIDE = 4, 96  # painted scenes and their sides in pixels
SCORES = {
    "capture_rmse": "light outside the window of 23 pixels lost",
    "capture_rmse_scaled": "PSFs scaled to sum one",
}


# ---------------------------------------------------------------------- captures


@lru_cache(maxsize=1)
def scenes() -> tuple[Tensor, Tensor]:
    """Return linear light of painted scenes at 530 nm, (S, 1, N, N), and the share of each layer, (S, 21, N, N)."""
    camera = ThinLensCamera()
    painted = [photographic_leaves(SIDE, SIDE, depth_range=camera.depth_range, seed=seed) for seed in range(SCENES)]
    light = torch.stack([rgb_to_linear_rgb(image)[1:2] for image, _ in painted])
    place = (torch.stack([camera.defocus(depth) for _, depth in painted]) - PSI[0]) / (PSI[1] - PSI[0])
    layers = torch.arange(len(PSI))[:, None, None]
    return light, (1 - (place.clamp(0, len(PSI) - 1) - layers).abs()).clamp(min=0)


@lru_cache(maxsize=1)
def spectra() -> Tensor:
    """Return the transforms of the scenes, with room for the PSFs."""
    return torch.fft.rfft2(scenes()[0], s=(SIDE + PAPER_SIZE - 1,) * 2)


def capture_error(psfs: Tensor, *, scaled: bool = False) -> float:
    """Return the root mean square difference of captures and scenes, without the border where PSFs leave it.

    Args:
        psfs: (21, 23, 23).
        scaled: to sum one at each depth, as if no light were lost outside the window.
    """
    psfs = psfs / psfs.sum((-2, -1), keepdim=True) if scaled else psfs
    light, shares = scenes()
    size, half = (SIDE + PAPER_SIZE - 1,) * 2, PAPER_SIZE // 2
    blurred = torch.fft.irfft2(spectra() * torch.fft.rfft2(psfs, s=size), s=size)
    blurred = blurred[..., half : half + SIDE, half : half + SIDE]
    error = (shares * blurred).sum(1, keepdim=True) - light
    return float(error[..., half:-half, half:-half].square().mean().sqrt())


@lru_cache(maxsize=2)
def without_masks(*, scaled: bool) -> tuple[float, float, float]:
    """Return the error of the lens without masks, of the best stopped-down one, and the diameter of that."""
    x = torch.linspace(-1.1, 1.1, PAPER_SIZE)
    rho = (x[:, None].square() + x.square()).sqrt()
    flat = torch.zeros(1, PAPER_SIZE, PAPER_SIZE)
    apertures = {step / 10: (rho <= step / 10 + 1e-6).float() for step in range(1, 11)}
    errors = {d: capture_error(psfs_of(flat, aperture), scaled=scaled) for d, aperture in apertures.items()}
    best = min(errors, key=lambda diameter: errors[diameter])
    return errors[1.0], errors[best], best


# ---------------------------------------------------------------------- the experiment


def trials(scale: str) -> list[Trial]:
    """Return the trials: each length and start, in the order of what is wanted most."""
    lengths = (1, 3) if scale == "smoke" else LENGTHS
    return [{"length": str(length), "seed": str(seed)} for length in lengths for seed in range(STARTS[scale])]


def measure(group: Sequence[Trial], scale: str) -> list[Mapping[str, float | str]]:
    """Optimise the starts of one length together, and return the scores of each."""
    torch.manual_seed(0)
    learnt = learn(
        first_phase(int(group[0]["length"]), [int(trial["seed"]) for trial in group]), STEPS[scale], impulse()
    )
    rows = []
    for start in range(len(group)):
        row = {
            "loss_before": float(learnt.before[start]),
            "loss": float(learnt.after[start]),
            "steps": float(learnt.steps[start]),
            "capture_rmse": capture_error(psfs := psfs_of(learnt.phase[start])),
            "capture_rmse_scaled": capture_error(psfs, scaled=True),
        }
        rows.append(row)
    return rows


def table(rows: Sequence[Row], scale: str) -> str:
    """Return a table of the lengths for each score, and what no masks reach."""
    parts = []
    for score, words in SCORES.items():
        lines = []
        for length in sorted({int(row["length"]) for row in rows}):
            own = [row for row in rows if row["length"] == str(length)]
            errors = sorted(float(row[score]) for row in own)
            low, high = (errors[min(len(errors) - 1, int(share * len(errors)))] for share in (0.05, 0.95))
            converged = sum(float(row["steps"]) < STEPS[scale] for row in own) / len(own)
            spread = f"{statistics.stdev(errors):.5f}" if len(errors) > 1 else "-"
            lines.append([
                str(length), f"{len(own)} of {STARTS[scale]}", f"{converged:.0%}", f"{errors[0]:.5f}",
                f"{statistics.median(errors):.5f}", f"{errors[-1]:.5f}", f"{high - low:.5f}", spread,
            ])  # fmt: skip
        flat, stopped, diameter = without_masks(scaled="scaled" in score)
        heading = ["masks", "starts", "converged", "best", "median", "worst", "5 to 95 %", "standard deviation"]
        parts += [
            f"Capture RMSE in linear light, {words}:",
            grid(heading, lines),
            f"Without masks {flat:.5f}; without masks and stopped down to {diameter:g} of the diameter, the best, at "
            f"equal light {stopped:.5f}.",
        ]
    return "\n\n".join([*parts, JUDGED])


JUDGED = """\
Judged can be the paper's finding in its own discretisation and for its own loss: how much the result depends on the
start, and how good the best is. Not judged can be its figure's values, whose scene, colours and stopping rule it does
not state. The loss counts pixels of the PSF alike and does not know scenes, so that what is best for it need not be
best for captures."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the errors of all starts over the length."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    lengths = sorted({int(row["length"]) for row in rows})
    for axes, (score, words) in zip(figure.subplots(1, 2), SCORES.items(), strict=True):
        groups = [[float(row[score]) for row in rows if row["length"] == str(length)] for length in lengths]
        for place, errors in enumerate(groups):
            spread = [place + 0.3 * math.sin(12.9898 * number) for number in range(len(errors))]
            axes.plot(spread, errors, ".", color=f"C{place}", markersize=2, alpha=0.5)
        axes.plot([min(errors) for errors in groups], "k_", markersize=24, label="best start")
        axes.plot([statistics.median(e) for e in groups], "k_", markersize=24, markeredgewidth=3, label="median")
        flat, stopped, diameter = without_masks(scaled="scaled" in score)
        axes.axhline(flat, color="grey", linestyle=":", label="no masks")
        axes.axhline(stopped, color="grey", linestyle="--", label=f"no masks, {diameter:g} of the diameter")
        axes.set(xlabel="masks, and starts", ylabel="capture RMSE, linear light", title=words)
        names = [f"{length}\n{len(errors)}" for length, errors in zip(lengths, groups, strict=True)]
        axes.set_xticks(range(len(lengths)), names)
        axes.legend(frameon=False, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return (
        f"{RULE}; 21 depths from -20 to 20 rad; at most {STEPS[scale]} steps, {TOGETHER[scale]} starts in a batch, "
        f"{SCENES} painted scenes of {SIDE} pixels."
    )


EXPERIMENT = Experiment(
    "point_psf", "2. All in focus without a network", trials, measure, table, settings, draw, together=TOGETHER
)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
