"""Point images of one distance brought together: their places between the pixels refined, the odd ones left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.calibration.dithering import ResolvedPSF, resolve_psf
from kornia_tidy.calibration.point_images import MARGIN, PointImage

ROUNDS, SMALL_STEP = 8, 5e-4  # of brightness, and in pixels
LEAST_MISFIT, TIMES_MEDIAN = 2.0, 3.0  # an image misfits beyond both


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
    from a point that is. An image whose residuals are larger than noise, and than those of the others, is left out.

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
            scaled, noise = light / brightness.view(-1, 1, 1, 1), variance / brightness.view(-1, 1, 1, 1) ** 2
            own = offsets - phases[:, None]  # of each channel
            psfs = [resolve_psf(scaled[used, c], own[c, used], noise[used, c], limit) for c, limit in enumerate(cutoff)]
            step, misfit = _newton_step(scaled[..., inside, inside], noise[..., inside, inside], psfs, own)
            step[:, 1:] -= step[used, 1:].mean(0)
            brightness = brightness * (1 + step[:, 0])
            offsets = offsets + step[:, 1:].clamp(-0.5, 0.5)
            if float(step[used].abs().max()) < SMALL_STEP:
                break
        leverage = sum(psf.leverage for psf in psfs) / len(psfs)
        misfit = torch.where(used, misfit / max(1 - leverage, 0.1), misfit)
        odd = used & (misfit > LEAST_MISFIT) & (misfit > TIMES_MEDIAN * misfit[used].median())
        if not bool(odd.any()):
            return Registered(psfs, brightness, offsets, misfit, used)
        used = used & (misfit < misfit[odd].max())  # the worst goes first: it may have spoilt the others


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
