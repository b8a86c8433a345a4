"""Tikhonov and Wiener inversion of captures in closed form, by one product for each spatial frequency.

Captures must be linear light. As the Fourier transform takes them for periodic, they are first extended by the width of
a PSF to a smooth periodic image (``border="smooth"``, see
:func:`~kornia_tidy.reconstruction.periodic.periodic_extension`). ``border="circular"`` is for images that are periodic.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_float_tensor, check_positive, printed
from kornia_tidy.kernels.precision import widest
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.periodic import periodic_extension
from kornia_tidy.render.borders import next_fast_size

BORDERS = ("smooth", "circular")


def tikhonov(
    capture: Tensor,
    psf: Tensor,
    weight: float | Tensor,
    *,
    prior: Tensor | None = None,
    veil: Tensor | None = None,
    border: str = "smooth",
) -> Tensor:
    r"""Deconvolve a capture with one PSF by Tikhonov regularisation towards a prior image.

    .. math:: \arg\min_x \lVert h * x - y \rVert^2 + \gamma \lVert x - x_0 \rVert^2, \qquad
              X = \frac{\bar{H} Y + \gamma X_0}{|H|^2 + \gamma}

    Args:
        capture: y, (B, C, H, W) linear light.
        psf: h, (C, P, P) with P odd.
        weight: :math:`\gamma`, positive, in units of the square of a PSF's energy. Or, for ``"circular"``, a tensor
            that broadcasts to the half spectrum (B, C, H, W // 2 + 1).
        prior: :math:`x_0`, as ``capture``. None is black, which gives Wiener's filter if ``weight`` is the ratio of the
            power spectra of noise and image. With the capture as prior (Sitzmann et al.) white stays white, and
            frequencies that the PSF does not pass are unchanged.
        veil: (C,) stray light, the fraction of light spread evenly over the image, or None.
        border: ``"smooth"`` or ``"circular"``.

    Returns:
        (B, C, H, W) in the capture's dtype, computed in float32 or better, also under autocast. It is neither clamped
        nor checked for NaN.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit, or ``weight`` is a number that is not positive.

    Convention:
        It inverts a convolution; for captures made with ``correlate=True`` flip the PSF by ``psf.flip(-2, -1)``.

    Source: Sitzmann et al., ACM Transactions on Graphics 37(4) 114 (2018); Wiener (1949).

    Example:
        >>> psf = torch.zeros(1, 3, 3)
        >>> psf[0, 1, 2] = 1.0  # moves every point to the right
        >>> capture = torch.tensor([0.0, 0.0, 1.0, 0.0]).view(1, 1, 1, 4)
        >>> tikhonov(capture, psf, 1e-6, border="circular").flatten() > 0.999
        tensor([False,  True, False, False])
    """
    check_float_tensor("psf", psf, 3, "(C, P, P)")
    if prior is not None and prior.shape != capture.shape:
        raise ValueError(f"prior must have the capture's shape {tuple(capture.shape)}, got {tuple(prior.shape)}")
    captured, transfer, size = _spectra(capture, psf, weight, veil, border)
    numerator = transfer.conj() * captured
    if prior is not None:
        expected = captured if prior is capture else _spectrum(prior, size, psf.dtype)
        numerator = numerator + weight * expected
    return _image(numerator / (_power(transfer) + weight), size, capture)


def tikhonov_layers(
    capture: Tensor,
    psfs: Tensor,
    weight: float | Tensor,
    *,
    veil: Tensor | None = None,
    border: str = "smooth",
) -> Tensor:
    r"""Separate a capture into depth layers: their blurred sum is the capture, and their energy is least.

    .. math:: \arg\min_{x_k} \lVert \sum_k h_k * x_k - y \rVert^2 + \gamma \sum_k \lVert x_k \rVert^2, \qquad
              X_k = \frac{\bar{H}_k Y}{\gamma + \sum_j |H_j|^2}

    The model is :func:`kornia_tidy.render.scatter`. All layers are solved jointly: at each frequency the normal matrix
    is the identity plus an outer product, which the Sherman-Morrison formula inverts without a D x D matrix. At each
    frequency a layer gets light in proportion to the transfer of its PSF.

    Args:
        capture: y, (B, C, H, W) linear light.
        psfs: h, (D, C, P, P) with P odd.
        weight: :math:`\gamma`, positive, in units of the square of a PSF's energy. Or, for ``"circular"``, a tensor
            that broadcasts to the half spectrum (B, C, H, W // 2 + 1).
        veil: (D, C) stray light, the fraction of light spread evenly over the image, or None.
        border: ``"smooth"`` or ``"circular"``.

    Returns:
        (B, D, C, H, W), with dtype, errors and convention of :func:`tikhonov`. The sum of the layers has the
        brightness of the scene.

    Source: Ikoma et al., Depth from Defocus with Learned Optics, ICCP 2021.

    Example:
        >>> tikhonov_layers(torch.rand(2, 3, 32, 48), torch.rand(5, 3, 7, 7), 1.0).shape
        torch.Size([2, 5, 3, 32, 48])
    """
    check_float_tensor("psfs", psfs, 4, "(D, C, P, P)")
    captured, transfer, size = _spectra(capture, psfs, weight, veil, border)
    common = captured / (_power(transfer).sum(0) + weight)
    return _image(transfer.conj() * common.unsqueeze(1), size, capture)


class Inversion(nn.Module):
    """Base class of the inversions, with a weight that stays positive as its logarithm is learnt.

    Args:
        weight: initial weight, positive.
        border: ``"smooth"`` or ``"circular"``.
        correlate: captures are correlations, as with fidelity ``"paper"``: PSFs are flipped by 180 degrees.

    Raises:
        ValueError: if the weight is not positive, or the border unknown.
    """

    def __init__(self, weight: float, border: str = "smooth", *, correlate: bool = False) -> None:
        super().__init__()
        check_positive("weight", weight)
        check_choice("border", border, BORDERS)
        self.log_weight = nn.Parameter(torch.tensor(float(weight)).log())
        self.border, self.correlate = border, correlate

    @property
    def weight(self) -> Tensor:
        """The weight, a positive scalar in float32 or float64."""
        return self.log_weight.to(torch.promote_types(self.log_weight.dtype, torch.float32)).exp()

    def _psfs(self, bank: PSFBank) -> Tensor:
        return bank.psfs.flip((-2, -1)) if self.correlate else bank.psfs

    def extra_repr(self) -> str:
        """Return the weight and the options."""
        return f"weight={printed(self.weight)}, border={self.border!r}, correlate={self.correlate}"


class Tikhonov(Inversion):
    """Deconvolution with the mean PSF of all layers, for masks whose PSF hardly changes with depth.

    The prior is the capture, so that white stays white for any weight. See :func:`tikhonov` and :class:`Inversion`.

    Args:
        weight: as for :class:`Inversion`. 0.03 suits cubic masks and read noise of 1 %.
        border: as for :class:`Inversion`.
        correlate: as for :class:`Inversion`.

    Shape:
        - ``(capture, bank)``: (B, C, H, W) linear light and a bank of C channels, to (B, C, H, W).
        - ``log_weight``: learnable scalar.

    Example:
        >>> bank = PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0))
        >>> round(Tikhonov()(torch.ones(1, 3, 16, 20), bank).mean().item(), 5)
        1.0
    """

    def __init__(self, weight: float = 3e-2, border: str = "smooth", *, correlate: bool = False) -> None:
        super().__init__(weight, border, correlate=correlate)

    def forward(self, capture: Tensor, bank: PSFBank) -> Tensor:
        """Return the estimate of the all-in-focus image."""
        veil = None if bank.veil is None else bank.veil.mean(0)
        psf = self._psfs(bank).mean(0)
        return tikhonov(capture, psf, self.weight, prior=capture, veil=veil, border=self.border)


class TikhonovLayers(Inversion):
    """Separation into depth layers, see :func:`tikhonov_layers` and :class:`Inversion`.

    Args:
        weight: as for :class:`Inversion`; Ikoma et al. use 1.
        border: as for :class:`Inversion`.
        correlate: as for :class:`Inversion`.

    Shape:
        - ``(capture, bank)``: (B, C, H, W) linear light and a bank of D layers, to (B, D, C, H, W).
        - ``log_weight``: learnable scalar.
    """

    def __init__(self, weight: float = 1.0, border: str = "smooth", *, correlate: bool = False) -> None:
        super().__init__(weight, border, correlate=correlate)

    def forward(self, capture: Tensor, bank: PSFBank) -> Tensor:
        """Return the layers."""
        return tikhonov_layers(capture, self._psfs(bank), self.weight, veil=bank.veil, border=self.border)


def transfer_function(psfs: Tensor, size: tuple[int, int], veil: Tensor | None = None) -> Tensor:
    r"""Return the half spectrum of PSFs on a periodic plane, with the chief ray on its first pixel.

    .. math:: H_{uv} = \sum_{yx} e^{-2 \pi i \, u y / M} \, h_{yx} \, e^{-2 \pi i \, v x / N}

    It is computed as two matrix products. A PSF fills so few rows and columns of the plane that this is faster than a
    fast Fourier transform of the zero-padded plane.

    Args:
        psfs: (..., P, P) with P odd, float32 or float64. PSFs larger than the plane wrap around.
        size: rows M and columns N of the plane.
        veil: (...) stray light, the fraction of light spread evenly over the plane, or None.

    Returns:
        Complex (..., M, N // 2 + 1).

    Example:
        >>> psf = torch.zeros(3, 3)
        >>> psf[1, 1] = 0.5
        >>> transfer_function(psf, (1, 2), veil=torch.tensor(0.25)).real
        tensor([[0.7500, 0.5000]])
    """
    rows, columns = size
    below, across = (_fourier_matrix(psfs, side, count) for side, count in ((rows, rows), (columns, columns // 2 + 1)))
    transfer = below @ (psfs.to(below.dtype) @ across.mT)
    if veil is None:
        return transfer
    return transfer + nn.functional.pad(veil[..., None, None], (0, columns // 2, 0, rows - 1))  # the zero frequency


def _fourier_matrix(psfs: Tensor, side: int, count: int) -> Tensor:
    """Return the DFT matrix (count, P) of a line of ``side`` pixels, for P pixels centred on its first one."""
    points = torch.arange(psfs.shape[-1], device=psfs.device) - psfs.shape[-1] // 2
    turns = (torch.arange(count, device=psfs.device)[:, None] * points).remainder(side)  # exact on wide planes
    phase = turns.to(widest(psfs.device)) * (-2 * math.pi / side)
    return torch.polar(torch.ones_like(phase), phase).to(torch.promote_types(psfs.dtype, torch.complex64))


def plane_of(capture: Tensor, psfs: Tensor, border: str) -> tuple[int, int]:
    """Check capture and PSFs, and return the size of the periodic plane on which they are transformed."""
    check_float_tensor("capture", capture, 4, "(B, C, H, W)")
    check_choice("border", border, BORDERS)
    channels, side, width = psfs.shape[-3:]
    if side != width or side % 2 == 0 or channels != capture.shape[1]:
        raise ValueError(
            f"PSFs must be (..., {capture.shape[1]}, P, P) with P odd for a capture of {capture.shape[1]} channels, "
            f"got {tuple(psfs.shape)}"
        )
    rows, columns = capture.shape[-2:]
    return (next_fast_size(rows + side), next_fast_size(columns + side)) if border == "smooth" else (rows, columns)


def _spectra(
    capture: Tensor, psfs: Tensor, weight: float | Tensor, veil: Tensor | None, border: str
) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Return the half spectra of the extended capture and of the PSFs on its plane, and the size of the plane."""
    if not isinstance(weight, Tensor):
        check_positive("weight", weight)
    size = plane_of(capture, psfs, border)
    captured = _spectrum(capture, size, psfs.dtype)
    precise = captured.real.dtype
    veil = None if veil is None else veil.to(precise)
    return captured, transfer_function(psfs.to(precise), size, veil), size


def _spectrum(image: Tensor, size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Return the half spectrum of an image on a periodic plane, in float32 or the precision of image or ``dtype``."""
    precise = torch.promote_types(torch.promote_types(image.dtype, dtype), torch.float32)
    if not len(image):  # torch transforms no empty batch
        return image.new_zeros(*image.shape[:-2], size[0], size[1] // 2 + 1, dtype=precise.to_complex())
    return torch.fft.rfft2(periodic_extension(image.to(precise), size))


def _power(transfer: Tensor) -> Tensor:
    return transfer.real.square() + transfer.imag.square()  # abs() has no gradient at zero


def _image(spectrum: Tensor, size: tuple[int, int], capture: Tensor) -> Tensor:
    """Return the image on a plane, cropped to the capture."""
    if not len(capture):
        return capture.new_empty(*spectrum.shape[:-2], *capture.shape[-2:])
    plane = torch.fft.irfft2(spectrum, s=size)
    return plane[..., : capture.shape[-2], : capture.shape[-1]].to(capture.dtype)
