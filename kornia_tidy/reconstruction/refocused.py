"""A network that sees a capture as it would be, were all of it at one depth, for each of some depths."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.head import ReconstructionHead, check_count
from kornia_tidy.render.borders import from_spectrum, next_fast_size, pad_border, to_spectrum

WEIGHT = 0.3  # of the prior in inverse filters, in units of a PSF's energy squared


def inverse_filters(psfs: Tensor, weight: float = WEIGHT) -> Tensor:
    r"""Return the filters that give of a capture each layer's share of light, cut off at the PSFs' window.

    .. math:: w_k = D \, \mathcal{F}^{-1} \left[ \frac{\bar{H}_k}{\gamma + \sum_j |H_j|^2} \right]

    :func:`~kornia_tidy.reconstruction.tikhonov.tikhonov_layers` with PSFs of one channel, times their number: at its
    own depth a texture comes out most like itself, at others blurred or ringing. Being cut off, they see no farther
    than PSFs reach, so that a picture can be reconstructed in tiles.

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
    # PSFs began at the corner, so what undoes them ends there.
    return len(psfs) * filters.roll((window - 1, window - 1), (-2, -1))[..., :window, :window]


class Refocused(ReconstructionHead):
    """Show a network a capture, and beside it the capture's brightness refocused to each of some depths.

    Where a scene lies is then a matter of comparing: the maps in which a place is sharp without ringing tell its depth.
    A network would have to learn such filters, as wide as the PSFs, by itself.

    Args:
        network: takes C + D channels: the capture, then its refocused brightness, layer by layer with the first of the
            bank first.
        layers: D.

    Shape:
        - image: (B, C, H, W), a capture as the network takes it.
        - output: the network's.

    Raises:
        ValueError: if the network takes no channels but those of the layers, a bank has another number of layers, or
            no bank was ever given.

    Convention:
        - Brightness is the channels' mean, of encoded captures the encoded one, whose blur filters undo only nearly.
        - Borders are continued as :class:`ReconstructionHead` says, then for the filters alike.
        - Filters are no weights: :meth:`look_through` computes them from the camera's PSFs. In training they are
          computed anew for every batch, and gradients reach the masks through them also.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), who show a network the layers of a closed
    form; see :class:`~kornia_tidy.reconstruction.tikhonov.Preconditioned`, which does so exactly, in linear light, and
    over the whole picture.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> head = Refocused(AttentionUNet(3 + 4, out_channels=1, width=4), layers=4).eval()
        >>> head.look_through(PSFBank.from_measured(torch.rand(4, 1, 5, 5), torch.arange(4.0)))
        >>> head(torch.rand(2, 3, 16, 20)).shape
        torch.Size([2, 1, 16, 20])
    """

    filters: Tensor

    def __init__(self, network: ReconstructionHead, layers: int = 9) -> None:
        check_count("layers", layers)
        super().__init__(network.in_channels - layers, network.out_channels)
        self.network, self.layers, self.stride = network, layers, network.stride
        network.looked = True  # at no capture: what is refocused overshoots [0, 1]
        self.register_buffer("filters", torch.zeros(0), persistent=False)

    def look_through(self, bank: PSFBank) -> None:
        """Compute the filters for a camera's PSFs; of several channels their mean."""
        if len(bank.psfs) != self.layers:
            raise ValueError(f"a network for {self.layers} layers needs as many PSFs, got {len(bank.psfs)}")
        self.filters = inverse_filters(bank.psfs.mean(1))

    def predict(self, image: Tensor) -> Tensor:
        """Return what the network makes of the capture and its refocused brightness."""
        if not self.filters.numel():
            raise ValueError("the network does not know its camera: call look_through(optics.psf_bank(...)) first")
        brightness = image.to(torch.promote_types(image.dtype, self.filters.dtype)).mean(1, keepdim=True)
        return self.network(torch.cat([image, _convolve(brightness, self.filters).to(image.dtype)], 1))


def _convolve(image: Tensor, filters: Tensor) -> Tensor:
    """Convolve (B, 1, H, W) with (D, P, P) to (B, D, H, W), continued at its borders."""
    window = filters.shape[-1]
    padded = pad_border(image, window // 2, "reflect" if window // 2 < min(image.shape[-2:]) else "replicate")
    if torch.compiler.is_compiling():  # exporters know no complex numbers
        return functional.conv2d(padded, filters.flip((-2, -1)).unsqueeze(1))
    unknown = padded.isnan()
    if marked := bool(unknown.any()):  # a transform would spread what is unknown over the whole picture
        padded = padded.where(~unknown, 0)
    size = padded.shape[-2], padded.shape[-1]
    spectrum = to_spectrum(padded, size)
    # Large pictures are looked at without gradients: one filter at a time takes a fraction of the memory.
    together = len(filters) if torch.is_grad_enabled() else 1
    layers = [from_spectrum(spectrum * to_spectrum(some, size), size, window) for some in filters.split(together)]
    convolved = torch.cat(layers, 1)
    if marked:
        convolved = convolved.masked_fill(functional.max_pool2d(unknown.to(padded.dtype), window, 1) > 0, torch.nan)
    return convolved
