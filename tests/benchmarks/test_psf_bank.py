"""How long PSFs take: by the number of masks, by their window, by the wavelengths."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.optics import camera_spectrum

SPECTRA = {1: Spectrum.monochrome, 3: Spectrum.rgb, 31: lambda: camera_spectrum(samples=31)}


def run(bench, device, masks=5, window=23, wavelengths=3, gradients=False):
    spectrum = SPECTRA[wavelengths]()
    optics = TiDyOptics(PixelwiseMask(masks), spectrum=spectrum, fidelity=Fidelity(window=window)).to(device)

    def action():
        with torch.set_grad_enabled(gradients):
            psfs = optics.psf_bank().psfs
        return torch.autograd.grad(psfs.square().sum(), optics.masks.phase) if gradients else psfs

    layers = len(optics.defocus_nodes)
    bench(action, size=0, masks=masks, layers=layers, window=window, wavelengths=wavelengths, pupil=23)


class TestPSFBank:
    @pytest.mark.parametrize("masks", [1, 5, 16])
    def test_by_masks(self, bench, device, masks):
        run(bench, device, masks=masks)

    @pytest.mark.parametrize("window", [9, 65])
    def test_by_window(self, bench, device, window):
        run(bench, device, window=window)

    @pytest.mark.parametrize("wavelengths", [1, 31])
    def test_by_wavelengths(self, bench, device, wavelengths):
        run(bench, device, wavelengths=wavelengths)

    def test_with_gradients(self, bench, device):
        run(bench, device, gradients=True)
