"""Experiment 2, all-in-focus without a network: how much does the best capture depend on where the masks begin?

    python -m examples.paper.point_psf --scale smoke
    python -m examples.paper.point_psf --scale paper        1,000 starts of each length: an hour of one core and more

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
from typing import NamedTuple

import torch
from kornia.color import rgb_to_linear_rgb
from matplotlib.figure import Figure
from torch import Tensor

from examples.paper.report import grid
from examples.paper.runner import Experiment, Row, Trial, main
from kornia_tidy import PixelwiseMask, ThinLensCamera
from kornia_tidy.data import photographic_leaves
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.psf.paper import PAPER_PAD, PAPER_SIZE, paper_psfs

LENGTHS = (1, 2, 3, 5, 4, 8, 16)  # the lengths that are wanted most come first
STARTS = {"smoke": 4, "cpu": 100, "gpu": 1000, "paper": 1000}
TOGETHER = {"smoke": 2, "cpu": 50, "gpu": 1000, "paper": 50}  # starts in a batch: 50 fit the caches of a processor
STEPS = {"smoke": 20, "cpu": 600, "gpu": 600, "paper": 600}  # at most
PSI = torch.linspace(-20, 20, 21)
WAVELENGTH, STEP = 530e-9, 6e-8  # m
SCENES, SIDE = 4, 96  # painted scenes and their sides in pixels
PATIENCE, LEAST_GAIN, HALVINGS = 20, 1e-4, 5
SCORES = {
    "capture_rmse": "light outside the window of 23 pixels lost",
    "capture_rmse_scaled": "PSFs scaled to sum one",
}
BETAS, EPS = (0.9, 0.999), 1e-15
RADIANS = math.pi / WAVELENGTH  # of a metre of height, at an index of 1.5


class Learnt(NamedTuple):
    """Masks that were optimised from several starts."""

    phase: Tensor
    """Radians, (T, K, 23, 23)."""
    before: Tensor
    """Loss of each start, (T,)."""
    after: Tensor
    """Loss at the end, (T,)."""
    steps: Tensor
    """Steps of each until it converged, (T,)."""


def first_phase(length: int, seeds: Sequence[int]) -> Tensor:
    """Return the phase of masks that begin as noise, (T, K, 23, 23)."""
    starts = [PixelwiseMask(length, generator=torch.Generator().manual_seed(seed)).phase for seed in seeds]
    return torch.stack(starts).detach()


@lru_cache(maxsize=1)
def lens() -> Tensor:
    """Return the field of the open aperture at each defocus, scaled so that PSFs sum to one before the crop."""
    x = torch.linspace(-1.1, 1.1, PAPER_SIZE, dtype=torch.float64)
    rho2 = x[:, None].square() + x.square()
    aperture = circular_aperture(PAPER_SIZE).double()
    angle = PSI.double()[:, None, None] * rho2
    scale = aperture / (PAPER_PAD * aperture.square().sum().sqrt())
    return torch.polar(scale.expand(angle.shape), angle).to(torch.complex64)


def losses_and_gradient(phase: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean squared difference of PSFs and impulse, (T,), and its gradient by the phase, (T, K, 23, 23).

    The PSFs are those of :func:`~kornia_tidy.psf.paper.paper_psfs` for each start. The gradient is written out, which
    takes half the time and a third of the memory of autograd's.
    """
    count, margin = phase.shape[1], (PAPER_PAD - PAPER_SIZE) // 2
    field = torch.polar(torch.ones_like(phase), phase)[:, None] * lens()[None, :, None]  # (T, D, K, 23, 23)
    wave = torch.fft.fft2(field, s=(PAPER_PAD, PAPER_PAD))
    wave = wave.roll((PAPER_PAD // 2, PAPER_PAD // 2), (-2, -1))
    wave = wave[..., margin : margin + PAPER_SIZE, margin : margin + PAPER_SIZE]
    psfs = (wave.real.square() + wave.imag.square()).mean(2)
    psfs[..., PAPER_SIZE // 2, PAPER_SIZE // 2] -= 1
    # Of the loss by the wave's conjugate, then back through crop, shift and transform to the field.
    by_wave = wave * (psfs[:, :, None] * (2 / (count * psfs[0].numel())))
    by_wave = torch.nn.functional.pad(by_wave, (margin, margin, margin, margin))
    by_wave = by_wave.roll((-(PAPER_PAD // 2), -(PAPER_PAD // 2)), (-2, -1))
    by_field = torch.fft.ifft2(by_wave)[..., :PAPER_SIZE, :PAPER_SIZE] * PAPER_PAD**2
    return psfs.square().mean((1, 2, 3)), 2 * (by_field * field.conj()).imag.sum(1)


def learn(phase: Tensor, most: int) -> Learnt:
    """Optimise each start by Adam until it has converged; the result of a start does not depend on the others."""
    count = len(phase)
    best, best_phase = torch.full((count,), math.inf), phase.clone()
    before, steps = torch.zeros(count), torch.zeros(count, dtype=torch.int64)
    active, phase = torch.arange(count), phase.clone()
    first, second = torch.zeros_like(phase), torch.zeros_like(phase)
    rate = torch.full((count,), STEP * RADIANS)
    waited, reached = torch.zeros(count), torch.full((count,), math.inf)
    for step in range(1, most + 1):
        losses, gradient = losses_and_gradient(phase)
        if step == 1:
            before = losses.clone()
        better = losses < best[active]
        best[active[better]], best_phase[active[better]] = losses[better], phase[better]
        gained = losses < reached * (1 - LEAST_GAIN)
        reached = torch.where(gained, losses, reached)
        waited = torch.where(gained, 0, waited + 1)
        halved = waited >= PATIENCE
        rate, waited = torch.where(halved, rate / 2, rate), torch.where(halved, 0, waited)
        steps[active] = step
        kept = rate > STEP * RADIANS / 2 ** (HALVINGS - 0.5)
        if not kept.any():
            break
        if not kept.all():
            active, phase, first, second, gradient = (part[kept] for part in (active, phase, first, second, gradient))
            rate, waited, reached = rate[kept], waited[kept], reached[kept]
        first.lerp_(gradient, 1 - BETAS[0])
        second.lerp_(gradient.square(), 1 - BETAS[1])
        direction = first / (1 - BETAS[0] ** step) / ((second / (1 - BETAS[1] ** step)).sqrt() + EPS)
        phase = phase - rate[:, None, None, None] * direction
    return Learnt(best_phase, before, best, steps)


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


def psfs_of(phase: Tensor, aperture: Tensor | None = None) -> Tensor:
    """Return the PSFs of one sequence, (21, 23, 23), by the library."""
    aperture = circular_aperture(PAPER_SIZE) if aperture is None else aperture
    return paper_psfs(phase, torch.full((len(phase),), 1 / len(phase)), aperture, PSI, WAVELENGTH)


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
    learnt = learn(first_phase(int(group[0]["length"]), [int(trial["seed"]) for trial in group]), STEPS[scale])
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
    return "\n\n".join(parts)


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
        f"Adam, steps of {STEP:g} m, halved after {PATIENCE} steps with less than {LEAST_GAIN:g} of gain, at most "
        f"{STEPS[scale]} steps; 530 nm, 21 depths from -20 to 20 rad, the paper's discretisation, {TOGETHER[scale]} "
        f"starts in a batch."
    )


EXPERIMENT = Experiment(
    "point_psf", "All in focus without a network", trials, measure, table, settings, draw, together=TOGETHER
)


if __name__ == "__main__":
    sys.exit(bool(main(EXPERIMENT, __doc__ or "") is None))
