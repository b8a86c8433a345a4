"""Networks with refocused captures as input: the capture deconvolved for each of several depths."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_count
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.render.borders import next_fast_size

WEIGHT = 0.3  # of the prior in inverse filters, in units of the square of a PSF's energy


def inverse_filters(psfs: Tensor, weight: float = WEIGHT) -> Tensor:
    r"""Return the inverse filters that separate a capture into depth layers, truncated to the window of the PSFs.

    .. math:: w_k = D \, \mathcal{F}^{-1} \left[ \frac{\bar{H}_k}{\gamma + \sum_j |H_j|^2} \right]

    They are those of :func:`~kornia_tidy.reconstruction.tikhonov.tikhonov_layers` for PSFs of one channel, times the
    number D of PSFs. A texture is restored best by the filter of its depth; other filters blur it or make it ring.
    Truncation bounds the receptive field, so that a picture can be reconstructed in tiles.

    Args:
        psfs: (D, P, P) with P odd.
        weight: :math:`\gamma`, positive.

    Returns:
        (D, P, P) in the dtype of ``psfs``; gradients reach the PSFs.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), for the closed form.

    Example:
        >>> point = torch.zeros(1, 5, 5)
        >>> point[0, 2, 2] = 1.0
        >>> round(inverse_filters(point, weight=0.25)[0, 2, 2].item(), 6)
        0.8
    """
    window = psfs.shape[-1]
    size = next_fast_size(2 * window)
    transfer = torch.fft.rfft2(psfs, s=(size, size))
    power = (transfer.real.square() + transfer.imag.square()).sum(0)
    filters = torch.fft.irfft2(transfer.conj() / (power + weight), s=(size, size))
    # PSFs begin at the corner of the plane, so their inverses end there.
    return len(psfs) * filters.roll((window - 1, window - 1), (-2, -1))[..., :window, :window]


class Refocused(ReconstructionHead):
    """Feeds a network the capture and, as further channels, its brightness refocused to each of several depths.

    The network then finds depth by comparison: the refocused map in which a region is sharp without ringing is that of
    its depth. Otherwise it would have to learn such filters, which are as wide as the PSFs.

    Args:
        network: takes C + D channels: the capture, then its refocused brightness, in the order of the bank's layers.
        layers: number D of depths.

    Shape:
        - image: (B, C, H, W), a capture as the network takes it.
        - output: the network's.

    Raises:
        ValueError: if the network has no more than D input channels, a bank has another number of layers, or no bank
            was given before the first image.

    Convention:
        - Brightness is the mean of the channels; for encoded captures it is not linear light, and the inversion is
          approximate.
        - Borders are padded as in :class:`ReconstructionHead`, and in the same way for the filters.
        - The filters are computed by :meth:`set_psfs` from the camera's PSFs and are not part of the state. In
          training they are computed for every batch, and gradients also reach the masks through them.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), for a network behind the layers of a
    closed form. :class:`~kornia_tidy.reconstruction.tikhonov.TikhonovLayers` gives them exactly, in linear light, by
    filters as large as the picture.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> head = Refocused(AttentionUNet(3 + 4, out_channels=1, width=4), layers=4).eval()
        >>> head.set_psfs(PSFBank.from_measured(torch.rand(4, 1, 5, 5), torch.arange(4.0)))
        >>> head(torch.rand(2, 3, 16, 20)).shape
        torch.Size([2, 1, 16, 20])
    """

    filters: Tensor

    def __init__(self, network: ReconstructionHead, layers: int = 9) -> None:
        check_count("layers", layers)
        super().__init__(network.in_channels - layers, network.out_channels)
        self.network, self.layers, self.stride = network, layers, network.stride
        network.range_checked = True  # no check of the range, as refocused maps leave [0, 1]
        self.register_buffer("filters", torch.zeros(0), persistent=False)

    def set_psfs(self, bank: PSFBank) -> None:
        """Compute the filters from a camera's PSFs, averaged over channels."""
        if len(bank.psfs) != self.layers:
            raise ValueError(f"a network for {self.layers} layers needs as many PSFs, got {len(bank.psfs)}")
        self.filters = inverse_filters(bank.psfs.mean(1))

    def predict(self, image: Tensor) -> Tensor:
        """Return the network's maps from the capture and its refocused brightness."""
        if not self.filters.numel():
            raise ValueError("the network does not know its camera: call set_psfs(optics.psf_bank(...)) first")
        brightness = image.to(torch.promote_types(image.dtype, self.filters.dtype)).mean(1, keepdim=True)
        refocused = convolve_kernels(brightness, self.filters.unsqueeze(1)).flatten(1, 2)
        return self.network(torch.cat([image, refocused.to(image.dtype)], 1))
