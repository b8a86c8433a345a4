"""Point images of one distance brought together: their places between the pixels refined, the odd ones left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.calibration.dithering import ResolvedPSF, resolve_psf
from kornia_tidy.calibration.point_images import MARGIN, PointImage

ROUNDS, SMALL_STEP = 8, 5e-4  # of brightness, and in pixels
LEAST_MISFIT, BETTER = 1.5, 0.7  # an image is odd where the mean misfit is above, and without it smaller by this
LEAST_IMAGES = 4  # of which one can be odd


@dataclass(frozen=True, eq=False)
class Registered:
    """What point images of one distance say together.

    Args:
        psfs: of each channel.
        brightness: (N,) of each image, on average one.
        offsets: (N, 2) of its chief ray from the centre of its pixel.
        misfit: (N,) mean square of its residuals in units of their variance.
        used: (N,) whether it was used.
    """

    psfs: list[ResolvedPSF]
    brightness: Tensor
    offsets: Tensor
    misfit: Tensor
    used: Tensor


def register(images: Sequence[PointImage], cutoff: Sequence[float]) -> Registered:
    """Find the PSFs of each channel together with the place and the brightness of each image.

    Rounds of two steps: PSFs for these places by :func:`resolve_psf`; then places and brightness for these PSFs by
    Gauss and Newton's step. The places as a whole stay where they are, as no image tells a PSF that is off its centre
    from a point that is. An image without which the others fit each other far better is left out.

    Args:
        images: N without fault.
        cutoff: of each channel, see :func:`resolve_psf`.

    Source: Anderson and King, Publications of the Astronomical Society of the Pacific 112, 1360 (2000).
    """
    light = torch.stack([image.light for image in images])
    variance = torch.stack([image.variance for image in images])
    offsets = torch.tensor([image.offset for image in images], dtype=torch.float64)
    phases = images[0].phases
    inside = slice(MARGIN, -MARGIN)
    brightness = light[..., inside, inside].sum((1, 2, 3))
    used = torch.ones(len(images), dtype=torch.bool)
    while True:
        brightness = brightness / brightness[used].mean()
        for _ in range(ROUNDS):
            fit = _Fit.of(light, variance, offsets - phases[:, None], brightness, cutoff, used)
            step = fit.step.clone()
            step[:, 1:] -= step[used, 1:].mean(0)
            brightness = brightness * (1 + step[:, 0].clamp(-0.5, 0.5))
            offsets = offsets + step[:, 1:].clamp(-0.5, 0.5)
            if float(step[used].abs().max()) < SMALL_STEP:
                break
        odd = _odd_one(light, variance, offsets - phases[:, None], brightness, cutoff, used, fit)
        if odd is None:
            return Registered(fit.psfs, brightness, offsets, fit.misfit, used)
        used[odd] = False


@dataclass(frozen=True, eq=False)
class _Fit:
    """PSFs for images at given places, the steps (N, 3) that their residuals ask for, and how large these are."""

    psfs: list[ResolvedPSF]
    step: Tensor
    misfit: Tensor

    @classmethod
    def of(
        cls,
        light: Tensor,
        variance: Tensor,
        offsets: Tensor,
        brightness: Tensor,
        cutoff: Sequence[float],
        used: Tensor,
    ) -> _Fit:
        scale, inside = brightness.view(-1, 1, 1, 1), slice(MARGIN, -MARGIN)
        light, variance = light / scale, variance / scale**2
        psfs = [
            resolve_psf(light[used, c], offsets[c, used], variance[used, c], limit) for c, limit in enumerate(cutoff)
        ]
        step, misfit = _newton_step(light[..., inside, inside], variance[..., inside, inside], psfs, offsets)
        leverage = sum(psf.leverage for psf in psfs) / len(psfs)  # what an image decides of the PSF is no residual
        return cls(psfs, step, torch.where(used, misfit / max(1 - leverage, 0.1), misfit))


def _odd_one(
    light: Tensor,
    variance: Tensor,
    offsets: Tensor,
    brightness: Tensor,
    cutoff: Sequence[float],
    used: Tensor,
    fit: _Fit,
) -> int | None:
    """Return the image without which the others fit each other far better, if there is one.

    It need not be the one with the largest residuals: few images follow one that is wrong.
    """
    before = float(fit.misfit[used].mean())
    if before < LEAST_MISFIT or int(used.sum()) < LEAST_IMAGES:
        return None
    candidates = used.nonzero().flatten().tolist()
    left = []
    for candidate in candidates:
        others = used.clone()
        others[candidate] = False
        left.append(float(_Fit.of(light, variance, offsets, brightness, cutoff, others).misfit[others].mean()))
    best = min(left)
    return candidates[left.index(best)] if best < BETTER * before else None


def _newton_step(
    light: Tensor, variance: Tensor, psfs: Sequence[ResolvedPSF], offsets: Tensor
) -> tuple[Tensor, Tensor]:
    """Return for each image the steps of relative brightness, row and column, (N, 3), and the mean square residual."""
    inside = slice(MARGIN, -MARGIN)
    normal, right, misfit = torch.zeros(len(light), 3, 3).double(), torch.zeros(len(light), 3).double(), 0.0
    for c, psf in enumerate(psfs):
        image, slopes = psf.seen_from(offsets[c])
        design = torch.cat([image[:, None], slopes], 1)[..., inside, inside].flatten(2)  # (N, 3, pixels)
        residual = (light[:, c] - image[..., inside, inside]).flatten(1)
        weighted = design / variance[:, c].flatten(1)[:, None]
        normal = normal + weighted @ design.mT
        right = right + (weighted @ residual[..., None])[..., 0]
        misfit = misfit + (residual.square() / variance[:, c].flatten(1)).mean(1) / len(psfs)
    return torch.linalg.solve(normal, right), torch.as_tensor(misfit)
