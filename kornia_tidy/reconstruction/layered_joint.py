"""Depth and image by layers: the capture deconvolved for each depth, blended by the estimated depth, then refined."""

from __future__ import annotations

import math

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.checks import check_count, check_positive, printed
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.closed_form import LEAST, SHARPNESS
from kornia_tidy.reconstruction.depth_distribution import depth_moments, interpolated_classes, layer_weights
from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood, likelihood_filters
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.residual import zero_last_convolution
from kornia_tidy.reconstruction.tikhonov import transfer_function
from kornia_tidy.reconstruction.truncation import SIDE, plane_of, truncated

WEIGHT = 1e-2  # of the prior in deconvolution, in units of the square of a PSF's energy
REFINED_FROM = 3 + 3 + 2  # channels: capture, blended image, mean and deviation of depth


def deconvolution_filters(psfs: Tensor, weight: float = WEIGHT) -> Tensor:
    r"""Return the filters that deconvolve a capture for each depth, truncated to three times the window of the PSFs.

    .. math:: w_k = \mathcal{F}^{-1} \left[ \frac{\bar{H}_k + \gamma}{|H_k|^2 + \gamma} \right]

    They are :func:`~kornia_tidy.reconstruction.tikhonov.tikhonov` with the capture as prior. Truncation keeps their sum
    of one, so that white stays white, and bounds the receptive field, so that a picture can be reconstructed in tiles.

    Args:
        psfs: (L, C, P, P) with P odd, linear light.
        weight: :math:`\gamma`, positive.

    Returns:
        (L, C, 3 P, 3 P) in the dtype of ``psfs``; gradients reach the PSFs.

    Raises:
        ValueError: if the weight is not positive.

    Source: Sitzmann et al., ACM Transactions on Graphics 37(4) 114 (2018), for the closed form.

    Example:
        >>> point = torch.zeros(1, 1, 3, 3)
        >>> point[..., 1, 1] = 1.0
        >>> deconvolution_filters(point)[0, 0, 4].round(decimals=5).abs()
        tensor([0., 0., 0., 0., 1., 0., 0., 0., 0.])
    """
    check_positive("weight", weight)
    size = plane_of(psfs)
    transfer = transfer_function(psfs, (size, size))
    power = transfer.real.square() + transfer.imag.square()
    filters = torch.fft.irfft2((transfer.conj() + weight) / (power + weight), s=(size, size))
    return truncated(filters, SIDE * psfs.shape[-1])


class LayeredJointHead(ReconstructionHead):
    r"""Estimates depth as a distribution, and the image from the capture deconvolved for each depth.

    One network sees the capture, its brightness deconvolved for each of L depths, and the likelihood of these depths in
    closed form. It estimates a correction of the logarithm of the likelihood; its last convolution is initialised with
    zeros. The deconvolved captures are blended in linear light by the probabilities p of their depths:

    .. math:: \hat x = \sum_k p_k \, (w_k * y)

    A second network sees the capture, this blend, and mean and standard deviation of the depth, and estimates a
    correction of the blend, initially zero.

    Args:
        depth_network: takes 3 + 2 L channels, returns D classes, evenly spaced over normalised inverse depth, and ends
            in a convolution.
        image_network: takes 8 channels, returns 3, and ends in a convolution.
        layers: number L of depths, at least 2.
        encoded: captures and images are encoded as sRGB. False: they are linear light.

    Shape:
        - image: (B, 3, H, W), a capture in [0, 1].
        - output: (B, D + 3, H, W): the logits of the classes, then the image.

    Raises:
        ValueError: if a network has other channels or does not end in a convolution, a bank has another number of
            layers or colours, or no bank was given before the first image.

    Convention:
        - The loss of the image does not reach the distribution: probabilities stay those of the depth.
        - In eval mode logits are divided by ``temperature``, a number in the state that is fitted after training (see
          :func:`~kornia_tidy.reconstruction.depth_distribution.fit_temperature`). It does not change the image.
        - Borders are padded as in :class:`ReconstructionHead`, and in the same way for the filters.
        - The filters are computed by :meth:`set_psfs` from the camera's PSFs and are not part of the state.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), for a network behind the layers of a
    closed form; the blend is the posterior mean if only depth is uncertain. For the likelihood see
    :func:`~kornia_tidy.reconstruction.depth_likelihood.depth_likelihood`.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> head = LayeredJointHead(AttentionUNet(3 + 2 * 4, 16, 2), AttentionUNet(8, 3, 2), layers=4).eval()
        >>> head.set_psfs(PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0)))
        >>> with torch.no_grad():
        ...     head(torch.rand(2, 3, 16, 20)).shape
        torch.Size([2, 19, 16, 20])
    """

    filters: Tensor
    whitening: Tensor
    log_determinants: Tensor
    temperature: Tensor

    def __init__(
        self,
        depth_network: ReconstructionHead,
        image_network: ReconstructionHead,
        layers: int = 11,
        *,
        encoded: bool = True,
    ) -> None:
        check_count("layers", layers, 2)
        check_count("the number of classes of depth_network", depth_network.out_channels, 2)
        for name, network, channels in (
            ("depth_network", depth_network, (3 + 2 * layers, depth_network.out_channels)),
            ("image_network", image_network, (REFINED_FROM, 3)),
        ):
            if (network.in_channels, network.out_channels) != channels:
                raise ValueError(
                    f"{name} must have {channels[0]} input and {channels[1]} output channels, got "
                    f"{network.in_channels} and {network.out_channels}"
                )
            zero_last_convolution(network, 1, name)
            network.range_checked = True  # no check of the range, as deconvolved maps leave [0, 1]
        super().__init__(3, depth_network.out_channels + 3)
        self.depth_network, self.image_network = depth_network, image_network
        self.layers, self.encoded = layers, encoded
        self.stride = math.lcm(depth_network.stride, image_network.stride)
        for name in ("filters", "whitening", "log_determinants"):
            self.register_buffer(name, torch.zeros(0), persistent=False)
        self.register_buffer("temperature", torch.ones(()))

    def set_psfs(self, bank: PSFBank, *, correlate: bool = False) -> None:
        """Compute the filters from a camera's PSFs, which are evenly spaced over its range of defocus.

        Args:
            bank: PSFs of three channels for each of the layers.
            correlate: captures are correlations, as with fidelity ``"paper"``: PSFs are flipped by 180 degrees.
        """
        psfs = bank.psfs.flip((-2, -1)) if correlate else bank.psfs
        if tuple(psfs.shape[:2]) != (self.layers, 3):
            raise ValueError(
                f"a network for {self.layers} layers of 3 colours needs as many PSFs, got {tuple(psfs.shape[:2])}"
            )
        self.filters = deconvolution_filters(psfs)
        self.whitening, self.log_determinants = likelihood_filters(psfs.mean(1))

    def predict(self, image: Tensor) -> Tensor:
        """Return the logits of the depth's classes and the image."""
        if not self.filters.numel():
            raise ValueError("the network does not know its camera: call set_psfs(optics.psf_bank(...)) first")
        capture = image.to(torch.promote_types(image.dtype, self.filters.dtype))
        light = self._to_light(capture)
        deconvolved = convolve_kernels(light, self.filters)
        fits = self._fits(light)
        seen = torch.cat([self._from_light(deconvolved).mean(2), 1 - fits / LEAST], 1).to(image.dtype)
        logits = self.depth_network(torch.cat([image, seen], 1))
        logits = logits + interpolated_classes(fits, logits.shape[1]).to(logits.dtype)
        known = logits.detach()
        weights = layer_weights(known, self.layers)
        blended = self._from_light((weights.unsqueeze(2) * deconvolved).sum(1)).to(image.dtype)
        moments = [moment.to(image.dtype) for moment in depth_moments(known)]
        refined = blended + self.image_network(torch.cat([image, blended, *moments], 1))
        if not self.training:
            logits = logits / self.temperature.to(logits.dtype)
        return torch.cat([logits, refined.to(logits.dtype)], 1)

    def _fits(self, light: Tensor) -> Tensor:
        """Return how well each layer fits, (B, L, H, W), from ``LEAST`` to 0."""
        fits = depth_likelihood(light.mean(1, keepdim=True), self.whitening, self.log_determinants)
        return (fits / SHARPNESS).clamp(min=LEAST)

    def extra_repr(self) -> str:
        """Return layers, classes and temperature."""
        return f"layers={self.layers}, classes={self.out_channels - 3}, temperature={printed(self.temperature)}"

    def _to_light(self, image: Tensor) -> Tensor:
        return rgb_to_linear_rgb(image) if self.encoded else image

    def _from_light(self, light: Tensor) -> Tensor:
        return linear_rgb_to_rgb(light.clamp(0, 1)) if self.encoded else light
