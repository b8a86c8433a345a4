"""Simulated flat fields by NumPy: Poisson electrons, Gaussian read noise, rounded counts."""

from __future__ import annotations

import numpy as np
import torch

from kornia_tidy.lab.raw import RawCapture, RawInfo

LEVELS = (0.0, 0.0, 0.02, 0.02, 0.1, 0.1, 0.3, 0.3, 0.7, 0.7)  # of saturation


def flat(
    rng,
    electrons,
    gain,
    read_noise,
    *,
    black=256,
    white=4095,
    side=256,
    pattern="RGGB",
    channels=1,
    fixed_pattern=0.01,
    vignetting=0.2,
    info=None,
):
    """Return a flat field with vignetting and fixed pattern noise."""
    y = np.linspace(-1, 1, side)
    light = np.broadcast_to(electrons, (channels, side, side)) * (1 - vignetting * (y[:, None] ** 2 + y**2) / 2)
    light = light * np.random.default_rng(1).normal(1, fixed_pattern, (channels, side, side))
    seen = rng.poisson(np.clip(light, 0, None)) + rng.normal(0, read_noise, (channels, side, side))
    counts = np.clip(np.round(seen / gain + black), 0, white).astype(np.int32)
    return RawCapture.from_counts(torch.from_numpy(counts), pattern, black, white, info or RawInfo())


def flats(rng, gain, read_noise, levels=LEVELS, *, black=256, white=4095, **options):
    """Return pairs of flat fields at rising levels, the first two dark."""
    full = gain * (white - black)
    return [flat(rng, full * level, gain, read_noise, black=black, white=white, **options) for level in levels]
