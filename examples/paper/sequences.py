"""Sequences of masks whose averaged PSFs are brought near wanted ones, from many starts at once.

The PSFs are those of the published discretisation at 530 nm, see :func:`kornia_tidy.psf.paper.paper_psfs`. Heights
follow Adam from steps of 6e-8 m. A start whose loss fell by less than a ten-thousandth in 20 steps continues with half
the step, and has converged after the fifth time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy import PixelwiseMask
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.psf.paper import PAPER_PAD, PAPER_SIZE, paper_psfs

PSI = torch.linspace(-20, 20, 21)
WAVELENGTH, STEP = 530e-9, 6e-8  # m
PATIENCE, LEAST_GAIN, HALVINGS = 20, 1e-4, 5
BETAS, EPS = (0.9, 0.999), 1e-15
RADIANS = math.pi / WAVELENGTH  # of a metre of height, at an index of 1.5
RULE = (
    f"Adam, steps of {STEP:g} m, halved after {PATIENCE} steps with less than {LEAST_GAIN:g} of gain; 530 nm, the "
    f"paper's discretisation"
)


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


def impulse() -> Tensor:
    """Return the unit impulse, (23, 23)."""
    wanted = torch.zeros(PAPER_SIZE, PAPER_SIZE)
    wanted[PAPER_SIZE // 2, PAPER_SIZE // 2] = 1
    return wanted


@lru_cache(maxsize=4)
def lens(psi: tuple[float, ...]) -> Tensor:
    """Return the field of the open aperture at each defocus, scaled so that PSFs sum to one before the crop."""
    x = torch.linspace(-1.1, 1.1, PAPER_SIZE, dtype=torch.float64)
    rho2 = x[:, None].square() + x.square()
    aperture = circular_aperture(PAPER_SIZE).double()
    angle = torch.tensor(psi, dtype=torch.float64)[:, None, None] * rho2
    scale = aperture / (PAPER_PAD * aperture.square().sum().sqrt())
    return torch.polar(scale.expand(angle.shape), angle).to(torch.complex64)


def losses_and_gradient(phase: Tensor, wanted: Tensor, psi: Tensor = PSI) -> tuple[Tensor, Tensor]:
    """Return the mean squared difference of PSFs and wanted ones, (T,), and its gradient by the phase, (T, K, 23, 23).

    The gradient is written out, which takes half the time and a third of the memory of autograd's.

    Args:
        phase: (T, K, 23, 23).
        wanted: PSFs, (23, 23) or (D, 23, 23).
        psi: defocus in radians, (D,).
    """
    count, margin = phase.shape[1], (PAPER_PAD - PAPER_SIZE) // 2
    field = (
        torch.polar(torch.ones_like(phase), phase)[:, None] * lens(tuple(psi.tolist()))[:, None]
    )  # (T, D, K, 23, 23)
    wave = torch.fft.fft2(field, s=(PAPER_PAD, PAPER_PAD))
    wave = wave.roll((PAPER_PAD // 2, PAPER_PAD // 2), (-2, -1))
    wave = wave[..., margin : margin + PAPER_SIZE, margin : margin + PAPER_SIZE]
    error = (wave.real.square() + wave.imag.square()).mean(2) - wanted
    # Of the loss by the wave's conjugate, then back through crop, shift and transform to the field.
    by_wave = wave * (error[:, :, None] * (2 / (count * error[0].numel())))
    by_wave = torch.nn.functional.pad(by_wave, (margin, margin, margin, margin))
    by_wave = by_wave.roll((-(PAPER_PAD // 2), -(PAPER_PAD // 2)), (-2, -1))
    by_field = torch.fft.ifft2(by_wave)[..., :PAPER_SIZE, :PAPER_SIZE] * PAPER_PAD**2
    return error.square().mean((1, 2, 3)), 2 * (by_field * field.conj()).imag.sum(1)


def learn(phase: Tensor, most: int, wanted: Tensor, psi: Tensor = PSI) -> Learnt:
    """Optimise each start by Adam until it has converged; the result of a start does not depend on the others.

    Args:
        phase: of the starts, (T, K, 23, 23).
        most: steps at most.
        wanted: PSFs, (23, 23) or (D, 23, 23).
        psi: defocus in radians, (D,).
    """
    count = len(phase)
    best, best_phase = torch.full((count,), math.inf), phase.clone()
    before, steps = torch.zeros(count), torch.zeros(count, dtype=torch.int64)
    active, phase = torch.arange(count), phase.clone()
    first, second = torch.zeros_like(phase), torch.zeros_like(phase)
    rate = torch.full((count,), STEP * RADIANS)
    waited, reached = torch.zeros(count), torch.full((count,), math.inf)
    for step in range(1, most + 1):
        losses, gradient = losses_and_gradient(phase, wanted, psi)
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


def psfs_of(phase: Tensor, aperture: Tensor | None = None, psi: Tensor = PSI) -> Tensor:
    """Return the PSFs of one sequence, (D, 23, 23), by the library."""
    aperture = circular_aperture(PAPER_SIZE) if aperture is None else aperture
    return paper_psfs(phase, torch.full((len(phase),), 1 / len(phase)), aperture, psi, WAVELENGTH)
