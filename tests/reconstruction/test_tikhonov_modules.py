"""The inversions as modules: precision, learning, what a network sees of them, errors, and a real scene."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import Wiener
from kornia_tidy.reconstruction.tikhonov import Tikhonov, TikhonovLayers, tikhonov, tikhonov_layers
from tests.base import BaseTester
from tests.reconstruction.banks import make_bank, make_psfs


class TestPrecision(BaseTester):
    def test_feature_float32_is_float64_to_rounding(self, device):
        capture, bank = torch.rand(1, 3, 61, 47, device=device), make_bank(5, 3, 9, device=device, dtype=torch.float32)
        double = PSFBank(*(v.double() for v in (bank.psfs, bank.defocus, bank.energy)))
        for module in (Tikhonov(1e-3), TikhonovLayers(1e-3)):
            self.assert_close(module(capture, bank).double(), module(capture.double(), double), atol=2e-6, rtol=0)

    def test_feature_gradients_are_finite_without_light(self, device):
        """Black captures, and PSFs that pass nothing."""
        psfs = torch.zeros(2, 1, 3, 3, device=device, requires_grad=True)
        bank = PSFBank(psfs, torch.arange(2.0, device=device), torch.zeros(2, 1, device=device))
        for module in (Tikhonov().to(device), TikhonovLayers().to(device), Wiener().to(device)):
            out = module(torch.zeros(1, 1, 6, 6, device=device), bank)
            assert (out == 0).all()
            for gradient in torch.autograd.grad(out.sum(), [psfs, module.log_weight]):
                assert gradient.isfinite().all()


class TestModules(BaseTester):
    @pytest.mark.parametrize("module", [Tikhonov, TikhonovLayers])
    def test_feature_the_weight_stays_positive_whatever_the_step(self, module, device):
        inversion = module(0.25).to(device)
        assert inversion.weight.item() == pytest.approx(0.25, rel=1e-6)
        bank = make_bank(device=device, dtype=torch.float32)
        inversion(torch.rand(1, 2, 8, 8, device=device), bank).square().sum().backward()
        assert inversion.log_weight.grad.isfinite()
        assert inversion.log_weight.grad != 0
        with torch.no_grad():
            inversion.log_weight -= 50
        assert inversion.weight > 0
        assert inversion(torch.rand(1, 2, 8, 8, device=device), bank).isfinite().all()
        assert list(inversion.state_dict()) == ["log_weight"]

    @pytest.mark.parametrize("module", [Tikhonov, TikhonovLayers])
    def test_exception_of_the_constructor(self, module):
        with pytest.raises(ValueError, match="weight must be positive and finite, got 0"):
            module(0)
        with pytest.raises(ValueError, match="border must be one of 'smooth', 'circular', got 'reflect'"):
            module(border="reflect")

    def test_exception_of_the_functions(self, device):
        capture, psfs = torch.rand(1, 2, 8, 8, device=device), make_psfs(device=device)
        with pytest.raises(ValueError, match=r"\(..., 1, P, P\) with P odd .* 1 channels, got \(3, 2, 5, 5\)"):
            tikhonov_layers(capture[:, :1], psfs, 1.0)
        with pytest.raises(ValueError, match=r"P odd .* got \(3, 2, 4, 4\)"):
            tikhonov_layers(capture, psfs[..., 1:, 1:], 1.0)
        with pytest.raises(ValueError, match=r"psf must have shape \(C, P, P\), got \(3, 2, 5, 5\)"):
            tikhonov(capture, psfs, 1.0)
        with pytest.raises(ValueError, match=r"weight must be positive and finite, got -1\.0"):
            tikhonov(capture, psfs[0], -1.0)
        with pytest.raises(ValueError, match=r"prior must have the capture's shape \(1, 2, 8, 8\), got \(1, 2, 8, 7\)"):
            tikhonov(capture, psfs[0], 1.0, prior=capture[..., 1:])
        with pytest.raises(ValueError, match="border must be one of 'smooth', 'circular', got 'valid'"):
            tikhonov(capture, psfs[0], 1.0, border="valid")
        with pytest.raises(ValueError, match=r"capture must have shape \(B, C, H, W\), got \(2, 8, 8\)"):
            tikhonov(capture[0], psfs[0], 1.0)
