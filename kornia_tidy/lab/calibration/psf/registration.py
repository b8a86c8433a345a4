"""Registration of point images at one distance: sub-pixel positions, brightness, and rejection of outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kornia_tidy.lab.calibration.psf.dithering import ResolvedPSF, resolve_psf
from kornia_tidy.lab.calibration.psf.point_images import MARGIN, PointImage

ROUNDS, SMALL_STEP = 8, 5e-4  # the step is relative in brightness and in pixels in position
# An image is an outlier if the mean misfit exceeds the first value, and without it falls below the second times that.
LEAST_MISFIT, IMPROVEMENT = 1.5, 0.7
LEAST_IMAGES = 4  # with fewer, no outlier can be identified
INSIDE = slice(MARGIN, -MARGIN)
NEAR = 5  # pixels along a side, over which the scatter of the images is averaged


@dataclass(frozen=True, eq=False)
class Registered:
    """PSFs of one distance, with the registration of the point images that they were measured from.

    Args:
        psfs: PSF of each channel, on the pixels of the sensor.
        brightness: (N,) relative brightness of each image, with a mean of one.
        offsets: (N, 2) position of each image's chief ray relative to the centre of its pixel.
        misfit: (N,) mean square of each image's residuals in units of their variance.
        used: (N,) whether each image was used.
        scatter: mean square of the images' residuals in units of their variance around each pixel of each PSF.
    """

    psfs: list[ResolvedPSF]
    brightness: Tensor
    offsets: Tensor
    misfit: Tensor
    used: Tensor
    scatter: list[Tensor]


def register(images: Sequence[PointImage], cutoff: Sequence[float]) -> Registered:
    """Register point images: estimate the PSF of each channel, and the position and brightness of each image.

    Each round has two steps: the PSFs for given positions by :func:`resolve_psf`, then positions and brightness for
    given PSFs by a Gauss-Newton step. The mean position stays fixed, because a shift of the PSF and a common shift of
    all points give the same images. An image is rejected if the others fit each other far better without it.

    Args:
        images: N images without fault.
        cutoff: highest frequency that the lens passes in each channel, in cycles per pixel of the sensor.

    Returns:
        The PSFs and the registration.

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
        outlier = _outlier(stack, offsets, brightness, used, fit)
        if outlier is None:
            psfs = stack.resolve(offsets, brightness, used, final=True)
            squares = stack.residuals(psfs, offsets, brightness, used).square()
            misfit = squares[..., INSIDE, INSIDE].mean((1, 2, 3))
            return Registered(psfs, brightness, offsets, misfit, used, stack.scatter(squares[used].mean(0)))
        used[outlier] = False


@dataclass(frozen=True, eq=False)
class _Stack:
    """Point images of one distance, (N, C, M, M). Planes of the same channel share a PSF."""

    light: Tensor
    variance: Tensor
    phases: Tensor
    channels: list[int]
    cutoff: Sequence[float]
    upsampling: int

    @classmethod
    def of(cls, images: Sequence[PointImage], cutoff: Sequence[float]) -> _Stack:
        light, variance = (torch.stack([getattr(image, name) for image in images]) for name in ("light", "variance"))
        tile = images[0].tile
        return cls(light, variance, images[0].phases, images[0].channels, cutoff, 1 if tile is None else len(tile))

    def resolve(self, offsets: Tensor, brightness: Tensor, used: Tensor, final: bool = False) -> list[ResolvedPSF]:
        """Return the PSF of each channel for given positions and brightness of the images.

        The final PSFs are on the pixels of the sensor and use weights for each pixel. The others are on the pixels of
        a plane and assume white noise, which is faster.
        """
        scale = brightness[used].view(-1, 1, 1, 1)
        light, variance = self.light[used] / scale, self.variance[used] / scale**2
        positions = offsets[used, None] - self.phases  # (N, C, 2)
        psfs = []
        for channel, limit in enumerate(self.cutoff):
            planes = [plane for plane, other in enumerate(self.channels) if other == channel]
            parts = (x[:, planes].flatten(0, 1) for x in (light, positions, variance))
            upsampling = self.upsampling if final else 1
            psfs.append(resolve_psf(*parts, limit * self.upsampling, upsampling, each_pixel=final))
        return psfs

    def residuals(self, psfs: Sequence[ResolvedPSF], offsets: Tensor, brightness: Tensor, used: Tensor) -> Tensor:
        """Return what PSFs leave of the images (N, C, M, M) in units of the noise, 1 on average for pure noise.

        The PSFs follow the noise of the images that were used, which lowers their residuals by the leverage.
        """
        scale = brightness.view(-1, 1, 1)
        residuals = []
        for plane, channel in enumerate(self.channels):
            image, _ = psfs[channel].images_at(offsets - self.phases[plane])
            rest = (self.light[:, plane] - scale * image) / self.variance[:, plane].sqrt()
            free = torch.where(used, max(1 - psfs[channel].leverage, 0.1), 1.0).view(-1, 1, 1)
            residuals.append(rest / free.sqrt())
        return torch.stack(residuals, 1)

    def scatter(self, squares: Tensor) -> list[Tensor]:
        """Average squared residuals (C, M, M) around each pixel of each PSF, on the pixels of the sensor."""
        near = avg_pool2d(squares[None], NEAR, 1, NEAR // 2, count_include_pad=False)[0]
        fine = near.repeat_interleave(self.upsampling, 1).repeat_interleave(self.upsampling, 2)
        planes = [[plane for plane, other in enumerate(self.channels) if other == n] for n in range(len(self.cutoff))]
        return [fine[own].mean(0) for own in planes]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Gauss-Newton steps (N, 3) of brightness, row and column, and the mean square residuals (N,)."""

    step: Tensor
    misfit: Tensor


def _fit(stack: _Stack, offsets: Tensor, brightness: Tensor, used: Tensor) -> _Fit:
    """Return the Gauss-Newton step of each image, after a fit of the PSFs to the current positions and brightness."""
    psfs = stack.resolve(offsets, brightness, used)
    scale = brightness.view(-1, 1, 1, 1)
    count = len(stack.channels)
    normal, right = torch.zeros(len(offsets), 3, 3).double(), torch.zeros(len(offsets), 3).double()
    misfit, leverage = torch.zeros(len(offsets)).double(), 0.0
    for plane, channel in enumerate(stack.channels):
        image, gradient = psfs[channel].images_at(offsets - stack.phases[plane])
        design = torch.cat([image[:, None], gradient], 1)[..., INSIDE, INSIDE].flatten(2)  # (N, 3, pixels)
        light, variance = (
            x[:, plane, INSIDE, INSIDE].flatten(1) for x in (stack.light / scale, stack.variance / scale**2)
        )
        residual = light - design[:, 0]
        # White noise, as resolve_psf assumes it. Both steps must minimise the same error for the rounds to converge.
        weighted = design / variance.mean(1)[:, None, None]
        normal = normal + weighted @ design.mT
        right = right + (weighted @ residual[..., None])[..., 0]
        misfit = misfit + (residual.square() / variance).mean(1) / count
        leverage += psfs[channel].leverage / count
    # The fit adapts the PSF to each image's own noise, which lowers the residuals by the leverage.
    return _Fit(torch.linalg.solve(normal, right), torch.where(used, misfit / max(1 - leverage, 0.1), misfit))


def _outlier(stack: _Stack, offsets: Tensor, brightness: Tensor, used: Tensor, fit: _Fit) -> int | None:
    """Return the index of the outlier, the image without which the others fit each other far better, or None.

    It need not have the largest residuals, because with few images the PSF adapts to the outlier.
    """
    before = float(fit.misfit[used].mean())
    if before < LEAST_MISFIT or int(used.sum()) < LEAST_IMAGES:
        return None
    candidates = used.nonzero().flatten().tolist()
    misfits = []
    for candidate in candidates:
        others = used.clone()
        others[candidate] = False
        misfits.append(float(_fit(stack, offsets, brightness, others).misfit[others].mean()))
    best = min(misfits)
    return candidates[misfits.index(best)] if best < IMPROVEMENT * before else None
