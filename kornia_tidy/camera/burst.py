"""Multi-shot: each mask read out by itself, to be compared with one exposure that averages them over time."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch
from torch import Tensor, nn

from kornia_tidy.camera.samples import read_sample
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_part
from kornia_tidy.modulator.switching import check_exposure
from kornia_tidy.sensor.sensor import SensorNoise


def burst_shares(shares: Tensor, dead_time: float, exposure: float) -> Tensor:
    r"""Return the share of a time interval in which each shot of a burst collects light.

    .. math:: s_k \left( 1 - (K - 1) \, t_d / T \right)

    Args:
        shares: dwell share :math:`s_k` of each mask, (K,), summing to one.
        dead_time: :math:`t_d` between shots in seconds.
        exposure: the interval T in seconds, from the start of the first shot to the end of the last.

    Returns:
        (K,). The rest to one is lost: :math:`(K - 1) t_d / T`.

    Raises:
        ValueError: if the dead time is negative, or the burst has no time left to collect light.

    Example:
        >>> burst_shares(torch.full((5,), 0.2), dead_time=5e-3, exposure=0.1)
        tensor([0.1600, 0.1600, 0.1600, 0.1600, 0.1600])
    """
    check_exposure(exposure)
    lost = (len(shares) - 1) * dead_time
    if not 0 <= lost < exposure:
        raise ValueError(
            f"{len(shares) - 1} pauses of dead_time = {dead_time * 1e3:g} ms must be shorter than the exposure of "
            f"{exposure * 1e3:g} ms, got {lost * 1e3:g} ms"
        )
    return shares * (1 - lost / exposure)


def burst(
    optics: TiDyOptics,
    image: Tensor,
    depth: Tensor,
    dead_time: float = 0.0,
    exposure: float = 0.1,
    generator: torch.Generator | None = None,
    field_center: Any = None,
) -> Tensor:
    """Take one picture through each mask instead of one through all: the same scene, camera and interval.

    Each shot has its share of the interval, less the dead time before the next, and its own shot, dark and read noise
    and conversion. One exposure of ``optics`` in the same interval loses no light and reads out once.

    Args:
        optics: the camera. Its modulator gives masks and dwell shares; its transitions between masks are hidden here,
            and light that passes beside the mask at all times is in every shot.
        image: (B, C, H, W) or (C, H, W), in the camera's colour space.
        depth: (B, 1, H, W) or (1, H, W).
        dead_time: seconds between shots in which no light is collected: readout or switching, whichever is longer.
        exposure: seconds from the start of the first shot to the end of the last.
        generator: source of the noise. Default: the global generator.
        field_center: where the middle of the picture lies from the axis of a lens, (2,), or of each image, (B, 2): y
            and x in sensor pixels. Default: the camera's.

    Returns:
        Linear light in the units of one full exposure: (B, K, C, H, W), or (K, C, H, W) for an unbatched image. Without
        noise the sum over K is the averaged exposure times 1 - (K - 1) dead_time / exposure.

    Raises:
        TypeError: if ``optics`` is no camera, or image or depth are no floating-point tensors.
        ValueError: if the burst has no time left to collect light, or image and depth do not fit.

    Convention:
        - Not encoded: shots are added and weighted in linear light. ``optics.decode`` and ``encode`` convert.
        - Each shot may fill the whole full well: a burst holds K times the light that one exposure can.
        - ``stray_light="renormalize"`` scales the PSFs of each mask, not their average, to a sum of one; then the sum
          over K has the light of the averaged exposure but not its exact PSF. ``"discard"`` and ``"veil"`` keep both.
        - Memory and readouts are K times those of one exposure; ``burst(...).sum(1)`` stores one picture with K times
          the variance of the read noise.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), supplement, section 2.

    Example:
        >>> from kornia_tidy import PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(2))
        >>> burst(optics, torch.rand(3, 80, 80), torch.ones(1, 80, 80), dead_time=10e-3).shape
        torch.Size([2, 3, 80, 80])
    """
    check_part("optics", optics, TiDyOptics, "a camera such as TiDyOptics(PixelwiseMask(5))")
    sample = read_sample(image, depth, optics, field_center=field_center)
    shots, light = [], optics.psf_model.relative_light(sample.dtype)
    shares = burst_shares(_dwell_shares(optics, sample.dtype), dead_time, exposure)
    seen = optics.irradiance(sample, [optics.through_moment(k) for k in range(len(shares))])
    for own, share, passed in zip(seen, shares, light[: len(shares)], strict=True):
        shot = own * (share * passed).to(own)
        shots.append(shot if optics.sensor is None else _sensor_for(optics.sensor, share)(shot, generator=generator))
    stack = torch.stack(shots, 1).to(sample.image.dtype)
    return stack if sample.batched else stack[0]


def _dwell_shares(optics: TiDyOptics, dtype: torch.dtype) -> Tensor:
    """Return the dwell shares of the K masks, scaled to sum to one; transitions between masks are left out."""
    shown = optics.timeline(dtype).durations[: optics.masks.phase.shape[0]]
    if not bool(shown.sum() > 0):
        raise ValueError("a burst needs masks that are shown for a time, but switching takes the whole exposure")
    return shown / shown.sum()


def _sensor_for(sensor: nn.Module, share: Tensor) -> nn.Module:
    """Return the sensor of one shot: dark signal gathers in the shot's time only."""
    if not getattr(sensor, "dark", 0):
        return sensor
    one = copy.copy(cast("SensorNoise", sensor))
    one.dark *= float(share.detach())
    return one
