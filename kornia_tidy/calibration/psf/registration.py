"""Point images of one distance brought together: their places between the pixels refined, the odd ones left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.calibration.psf.dithering import ResolvedPSF, resolve_psf
from kornia_tidy.calibration.psf.point_images import MARGIN, PointImage

ROUNDS, SMALL_STEP = 8, 5e-4  # of brightness, and in pixels
LEAST_MISFIT, BETTER = 1.5, 0.7  # an image is odd where the mean misfit is above, and without it smaller by this
LEAST_IMAGES = 4  # of which one can be odd
INSIDE = slice(MARGIN, -MARGIN)


@dataclass(frozen=True, eq=False)
class Registered:
    """What point images of one distance say together.

    Args:
        psfs: of each channel, on the pixels of the sensor.
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
        cutoff: highest frequency that the lens passes in each channel, in cycles per pixel of the sensor.

    Source: Anderson and King, Publications of the Astronomical Society of the Pacific 112, 1360 (2000).
    """
    stack = _Stack.of(images, cutoff)
    offsets = torch.tensor([image.offset for image in images], dtype=torch.float64)
    brightness = stack.light[..., INSIDE, INSIDE].sum((1, 2, 3))
    used = torch.ones(len(images), dtype=torch.bool)
    while True:
        brightness = brightness / brightness[used].mean()
        for _ in range(ROUNDS):
            fit = _fit(stack, offsets, brightness, used)
            step = fit.step.clone()
            step[:, 1:] -= step[used, 1:].mean(0)
            brightness = brightness * (1 + step[:, 0].clamp(-0.5, 0.5))
            offsets = offsets + step[:, 1:].clamp(-0.5, 0.5)
            if float(step[used].abs().max()) < SMALL_STEP:
                break
        odd = _odd_one(stack, offsets, brightness, used, fit)
        if odd is None:
            return Registered(
                stack.resolve(offsets, brightness, used, final=True), brightness, offsets, fit.misfit, used
            )
        used[odd] = False


@dataclass(frozen=True, eq=False)
class _Stack:
    """The images of one distance, (N, C, M, M), whose planes of one channel share a PSF."""

    light: Tensor
    variance: Tensor
    phases: Tensor
    channels: list[int]
    cutoff: Sequence[float]
    finer: int

    @classmethod
    def of(cls, images: Sequence[PointImage], cutoff: Sequence[float]) -> _Stack:
        light, variance = (torch.stack([getattr(image, name) for image in images]) for name in ("light", "variance"))
        tile = images[0].tile
        return cls(light, variance, images[0].phases, images[0].channels, cutoff, 1 if tile is None else len(tile))

    def resolve(self, offsets: Tensor, brightness: Tensor, used: Tensor, final: bool = False) -> list[ResolvedPSF]:
        """PSFs of each channel for images of these places and brightness, in the end with all that can be known."""
        scale = brightness[used].view(-1, 1, 1, 1)
        light, variance = self.light[used] / scale, self.variance[used] / scale**2
        places = offsets[used, None] - self.phases  # (N, C, 2)
        psfs = []
        for channel, limit in enumerate(self.cutoff):
            own = [plane for plane, seen in enumerate(self.channels) if seen == channel]
            parts = (x[:, own].flatten(0, 1) for x in (light, places, variance))
            psfs.append(resolve_psf(*parts, limit * self.finer, self.finer if final else 1, each_pixel=final))
        return psfs


@dataclass(frozen=True, eq=False)
class _Fit:
    """The steps (N, 3) of brightness, row and column that residuals ask for, and how large the residuals are."""

    step: Tensor
    misfit: Tensor


def _fit(stack: _Stack, offsets: Tensor, brightness: Tensor, used: Tensor) -> _Fit:
    """Return what the residuals of PSFs for these places and brightness say of each image."""
    psfs = stack.resolve(offsets, brightness, used)
    scale = brightness.view(-1, 1, 1, 1)
    count = len(stack.channels)
    normal, right = torch.zeros(len(offsets), 3, 3).double(), torch.zeros(len(offsets), 3).double()
    misfit, leverage = torch.zeros(len(offsets)).double(), 0.0
    for plane, channel in enumerate(stack.channels):
        image, slopes = psfs[channel].seen_from(offsets - stack.phases[plane])
        design = torch.cat([image[:, None], slopes], 1)[..., INSIDE, INSIDE].flatten(2)  # (N, 3, pixels)
        light, variance = (
            x[:, plane, INSIDE, INSIDE].flatten(1) for x in (stack.light / scale, stack.variance / scale**2)
        )
        residual = light - design[:, 0]
        # White noise, as resolve_psf takes it: other weights are not minimized by both steps, and need not converge.
        weighted = design / variance.mean(1)[:, None, None]
        normal = normal + weighted @ design.mT
        right = right + (weighted @ residual[..., None])[..., 0]
        misfit = misfit + (residual.square() / variance).mean(1) / count
        leverage += psfs[channel].leverage / count
    # What an image decides of the PSF is no residual.
    return _Fit(torch.linalg.solve(normal, right), torch.where(used, misfit / max(1 - leverage, 0.1), misfit))


def _odd_one(stack: _Stack, offsets: Tensor, brightness: Tensor, used: Tensor, fit: _Fit) -> int | None:
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
        left.append(float(_fit(stack, offsets, brightness, others).misfit[others].mean()))
    best = min(left)
    return candidates[left.index(best)] if best < BETTER * before else None
