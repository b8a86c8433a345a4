"""Networks that see a capture refocused."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import AttentionUNet, ReconstructionHead, Refocused
from kornia_tidy.reconstruction.refocused import inverse_filters
from kornia_tidy.reconstruction.tikhonov import tikhonov_layers
from tests.base import BaseTester
from tests.reconstruction.onnx_export import check_onnx


def discs(window=9, dtype=torch.float32):
    """PSFs of growing defocus, (4, P, P)."""
    y, x = np.mgrid[:window, :window] - window // 2
    discs = torch.from_numpy(np.stack([np.hypot(x, y) <= radius for radius in (0.5, 1.5, 2.5, 3.5)])).to(dtype)
    return discs / discs.sum((1, 2), keepdim=True)


def circular(image, psf):
    """Convolve with a PSF in an image that repeats, by SciPy."""
    return torch.from_numpy(convolve2d(image.numpy(), psf.numpy(), "same", "wrap"))


def bank(dtype=torch.float32):
    return PSFBank.from_measured(discs(dtype=dtype)[:, None], torch.arange(4.0))


class Shown(ReconstructionHead):
    """Returns what it is shown."""

    stride = 1

    def predict(self, image):
        return image


def refocused(network, dtype=torch.float32):
    head = Refocused(network, layers=4).eval()
    head.set_psfs(bank(dtype))
    return head


class TestInverseFilters(BaseTester):
    def test_feature_are_the_closed_form_where_nothing_is_cut_off(self):
        """Of a capture in an empty surround, by the solver for whole images."""
        psfs = torch.zeros(4, 41, 41, dtype=torch.float64)
        psfs[:, 16:25, 16:25] = discs(dtype=torch.float64)
        capture = torch.zeros(1, 1, 41, 41, dtype=torch.float64)
        capture[..., 20, 20] = 1.0
        layers = tikhonov_layers(capture, psfs[:, None], 0.3, border="circular")[0, :, 0]
        self.assert_close(inverse_filters(psfs), 4 * layers, atol=2e-3, rtol=0)

    def test_gradcheck(self, device):
        self.gradcheck(inverse_filters, (discs(5, torch.float64).to(device).requires_grad_(),))


class TestRefocused(BaseTester):
    @pytest.mark.parametrize("size", [(20, 33), (3, 12)])
    def test_feature_shows_convolutions_with_the_filters(self, size):
        """By SciPy; in a side as short as a filter's half the outermost pixel is repeated."""
        head = refocused(Shown(7, 7), torch.float64)
        image = torch.rand(1, 3, *size, dtype=torch.float64)
        shown = head(image)
        assert torch.equal(shown[:, :3], image)
        padded = np.pad(image[0].mean(0).numpy(), 4, "reflect" if min(size) > 4 else "edge")
        for filtered, psf in zip(shown[0, 3:], inverse_filters(discs(dtype=torch.float64)), strict=True):
            self.assert_close(filtered, torch.from_numpy(convolve2d(padded, psf.numpy(), "valid")))

    @pytest.mark.slow
    def test_feature_onnx(self):
        check_onnx(refocused(AttentionUNet(7, 4, width=2)), torch.rand(1, 3, 21, 32))

    def test_smoke_copies_without_its_filters_in_the_weights(self):
        head = refocused(Shown(7, 7))
        assert not head.state_dict()
        image = torch.rand(1, 3, 12, 12)
        assert torch.equal(copy.deepcopy(head)(image), head(image))

    def test_exception(self):
        head = Refocused(Shown(7, 7), layers=4)
        with pytest.raises(ValueError, match=r"does not know its camera: call set_psfs\(optics.psf_bank\(...\)\)"):
            head(torch.rand(1, 3, 8, 8))
        with pytest.raises(ValueError, match="a network for 3 layers needs as many PSFs, got 4"):
            Refocused(Shown(7, 7), layers=3).set_psfs(bank())
        with pytest.raises(ValueError, match="in_channels must be a whole number of at least 1, got 0"):
            Refocused(Shown(4, 7), layers=4)
        with pytest.raises(ValueError, match="layers must be a whole number of at least 1, got 0"):
            Refocused(Shown(7, 7), layers=0)
