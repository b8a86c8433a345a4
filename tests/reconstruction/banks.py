"""What the inversion tests share: small banks without symmetry, and captures of plane scenes."""

from __future__ import annotations

import torch

from kornia_tidy import PSFBank
from kornia_tidy.render import render


def make_psfs(layers=3, channels=2, size=5, *, peak=0.6, device="cpu", dtype=torch.float64):
    """PSFs without symmetry that pass every frequency: their peak holds more than half of the light."""
    psfs = torch.rand(layers, channels, size, size, device=device, dtype=dtype)
    psfs = (1 - peak) * psfs / psfs.sum((-2, -1), keepdim=True)
    psfs[..., size // 2, size // 2] += peak
    return psfs


def make_bank(*args, **kwargs) -> PSFBank:
    psfs = make_psfs(*args, **kwargs)
    return PSFBank.from_measured(psfs, torch.arange(float(len(psfs)), device=psfs.device))


def flat_capture(image, psf, border="circular", veil=None, **options):
    """The renderer's capture of a plane scene through one PSF (C, P, P)."""
    energy = torch.ones(1, len(psf), dtype=psf.dtype, device=psf.device)
    bank = PSFBank(psf[None], torch.zeros(1, device=psf.device), energy, veil)
    defocus = torch.zeros(1, 1, *image.shape[-2:], device=image.device)
    return render(image, defocus, bank, border=border, **options)
