"""Depth and image by layers: a closed form blended by the distribution of depth, and what a network adds."""

from __future__ import annotations

import pytest
import torch
from kornia.color import linear_rgb_to_rgb
from torch import nn

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import (
    JointHead,
    LayeredJointHead,
    ReconstructionHead,
)
from kornia_tidy.reconstruction.depth_distribution import depth_moments, soft_targets
from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.reconstruction.layered_joint import LEAST, SHARPNESS, WEIGHT, deconvolution_filters
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.tikhonov import tikhonov
from kornia_tidy.render import render
from tests.base import BaseTester
from tests.reconstruction.banks import make_psfs
from tests.reconstruction.onnx_export import check_onnx

LAYERS, CLASSES = 3, 5


class Told(ReconstructionHead):
    """Returns the logits that it was told, whatever it is shown."""

    stride = 1

    def __init__(self, logits):
        super().__init__(3 + 2 * LAYERS, logits.shape[1])
        self.logits = logits
        self.unused = nn.Conv2d(1, 1, 1)  # which would be the last

    def predict(self, image):
        return self.logits


def box_bank(dtype=torch.float32):
    """PSFs that are sharp in the middle layer and 3 and 5 pixels wide at the ends of the range."""
    psfs = torch.zeros(LAYERS, 3, 7, 7, dtype=dtype)
    for layer, radius in enumerate((2, 0, 1)):
        psfs[layer, :, 3 - radius : 4 + radius, 3 - radius : 4 + radius] = 1 / (2 * radius + 1) ** 2
    return PSFBank.from_measured(psfs, torch.arange(float(LAYERS)))


def layered(depth_network=None, *, encoded=True, dtype=torch.float32, width=4):
    torch.manual_seed(0)
    depth_network = PlainHead(3 + 2 * LAYERS, CLASSES, width) if depth_network is None else depth_network
    head = LayeredJointHead(depth_network, PlainHead(8, 3, width), LAYERS, encoded=encoded).to(dtype).eval()
    head.set_psfs(box_bank(dtype))
    return head


def told(logits, **options):
    """A head that blends by these logits alone."""
    head = layered(Told(logits), **options)
    head.whitening.zero_()
    head.log_determinants.zero_()
    return head


def stirred(**options):
    """A head with the large logits and refinement of a trained one."""
    head = layered(**options)
    for network in (head.depth_network, head.image_network):
        nn.init.normal_(network.layers[-1].weight, std=0.5, generator=torch.Generator().manual_seed(0))
    return head


def scene():
    """A texture with the spectrum of real scenes, near in its upper half, and its capture in linear light."""
    noise = torch.randn(1, 3, 60, 64, generator=torch.Generator().manual_seed(0))
    frequency = (torch.fft.fftfreq(60)[:, None].square() + torch.fft.rfftfreq(64).square()).sqrt()
    image = torch.fft.irfft2(torch.fft.rfft2(noise) * (frequency + 1 / 64) ** -1.45, s=(60, 64))
    image = 0.5 + 0.1 * image / image.std()
    depth = torch.ones(1, 1, 60, 64)
    depth[..., 30:, :] = 0.0
    return image, depth, render(image, 2 * depth, box_bank(), border="reflect")


class TestDeconvolutionFilters(BaseTester):
    def test_feature_are_the_closed_form_where_nothing_is_cut_off(self):
        """Of a point, by the solver for whole images: PSFs that pass every frequency have short inverses."""
        psfs = make_psfs(2, 3, 5, peak=0.8)
        wide = nn.functional.pad(psfs, (13, 13, 13, 13))
        point = torch.zeros(1, 3, 93, 93, dtype=torch.float64)
        point[..., 46, 46] = 1.0
        expected = torch.cat([tikhonov(point, psf, WEIGHT, prior=point, border="circular") for psf in psfs])
        self.assert_close(deconvolution_filters(wide), expected, atol=1e-6, rtol=0)

    def test_feature_white_stays_white(self, dtype):
        psfs = make_psfs(2, 3, 5).to(dtype)
        if dtype in {torch.float32, torch.float64}:  # Fourier transforms are for these
            self.assert_close(deconvolution_filters(psfs).sum((-2, -1)), torch.ones(2, 3))

    def test_gradcheck(self, device):
        self.gradcheck(deconvolution_filters, (make_psfs(1, 1, 3, device=device),))

    def test_exception(self):
        with pytest.raises(ValueError, match="weight must be positive"):
            deconvolution_filters(make_psfs(1, 1, 3), 0.0)


class TestLayeredJointHead(BaseTester):
    def test_feature_blended_by_the_true_depth_is_better_than_by_any_constant(self):
        image, depth, capture = scene()

        def score(inverse):
            head = told(soft_targets(inverse, CLASSES).clamp(min=1e-6).log(), encoded=False)
            return psnr(head(capture)[:, -3:], image).item()

        constants = [score(torch.full_like(depth, value)) for value in (0.0, 0.5, 1.0)]
        assert score(depth) > max(*constants, psnr(capture, image).item()) + 1

    def test_feature_the_initial_depth_is_the_likelihood_in_closed_form(self):
        """And finds on which side of an edge a texture is near."""
        _, depth, capture = scene()
        with torch.no_grad():
            head = layered(encoded=False)
            logits = head(capture)[:, :CLASSES]
            light = depth_likelihood(capture.mean(1, keepdim=True), head.whitening, head.log_determinants)
        self.assert_close(logits[:, ::2], (light / SHARPNESS).clamp(min=LEAST), atol=1e-4, rtol=1e-4)
        found = depth_moments(logits)[0]
        assert found[depth == 1].mean() > found[depth == 0].mean() + 0.2

    def test_feature_encoded_captures_are_blended_in_linear_light(self):
        _, depth, capture = scene()
        logits = torch.randn(1, CLASSES, *depth.shape[-2:])
        light = told(logits, encoded=False)(capture)[:, -3:].clamp(0, 1)
        image = told(logits)(linear_rgb_to_rgb(capture))[:, -3:]
        self.assert_close(image, linear_rgb_to_rgb(light), atol=1e-5, rtol=0)

    def test_feature_the_loss_of_the_image_does_not_reach_the_distribution(self):
        head = layered().train()
        head(torch.rand(1, 3, 20, 20))[:, -3:].square().sum().backward()
        assert all(p.grad is None or not p.grad.any() for p in head.depth_network.parameters())
        assert head.image_network.layers[-1].weight.grad.any()
        head(torch.rand(1, 3, 20, 20))[:, :CLASSES].square().sum().backward()
        assert head.depth_network.layers[-1].weight.grad.any()

    @pytest.mark.slow
    def test_feature_onnx(self):
        capture = scene()[2][..., 20:41, :32]
        assert len(check_onnx(JointHead(stirred()), torch.cat([capture] * 2), capture.flip(-1))) == 3

    def test_exception(self):
        with pytest.raises(ValueError, match="depth_network must have 9 input and 5 output channels, got 7 and 5"):
            LayeredJointHead(PlainHead(7, 5, 2), PlainHead(8, 3, 2), LAYERS)
        with pytest.raises(ValueError, match="image_network must have 8 input and 3 output channels, got 6 and 3"):
            LayeredJointHead(PlainHead(9, 5, 2), PlainHead(6, 3, 2), LAYERS)
        with pytest.raises(ValueError, match="layers must be a whole number of at least 2, got 1"):
            LayeredJointHead(PlainHead(5, 5, 2), PlainHead(8, 3, 2), 1)
        with pytest.raises(ValueError, match=r"3 layers of 3 colours needs as many PSFs, got \(3, 1\)"):
            layered().set_psfs(PSFBank.from_measured(torch.rand(3, 1, 5, 5), torch.arange(3.0)))
        head = LayeredJointHead(PlainHead(9, 5, 2), PlainHead(8, 3, 2), LAYERS)
        with pytest.raises(ValueError, match="does not know its camera"):
            head(torch.rand(1, 3, 8, 8))
