"""Borders of the image, and convolution with a PSF by products of spectra.

An image plane is padded by the PSF's radius on each side, multiplied with the PSF's spectrum, and the part that no
wrap-around has touched is cut out. Borders: ``reflect`` (``...c b | a b c...``, OpenCV's reflect101), ``replicate``
(``a a | a b c``), ``zero``, ``circular`` (``...y z | a b c``), and ``valid``: nothing is made up, and the output is
smaller by the PSF's side less one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.kernels.window_sides import next_fast_size

BORDERS = ("reflect", "replicate", "zero", "circular", "valid")
PAD_MODES = {"reflect": "reflect", "replicate": "replicate", "zero": "constant", "circular": "circular"}


def check_border(border: str, height: int, width: int, psf_size: int) -> None:
    """Raise ``ValueError`` if the border is not known, or an image of this size is too small for it."""
    check_choice("border", border, BORDERS)
    radius = psf_size // 2
    smallest_side = {"reflect": radius + 1, "replicate": 1, "zero": 1, "circular": max(radius, 1), "valid": psf_size}
    fitting = [name for name in BORDERS if min(height, width) >= smallest_side[name]]
    if border not in fitting:
        raise ValueError(
            f"border {border!r} needs an image of at least {smallest_side[border]} pixels a side for PSFs of "
            f"{psf_size}x{psf_size}, got {height}x{width}; borders that work here: {', '.join(map(repr, fitting))}"
        )


def largest_window(border: str, height: int, width: int) -> int:
    """Return the largest window that a border allows an image of this size; ``valid`` keeps half the view.

    Example:
        >>> largest_window("reflect", 48, 64), largest_window("valid", 48, 64)
        (95, 23)
    """
    side = min(height, width)
    limits = {"reflect": 2 * side - 1, "circular": 2 * side + 1, "valid": max(1, side // 2 - 1 + side // 2 % 2)}
    return limits.get(border, 2**31 - 1)


def pad_border(image: Tensor, radius: int, border: str) -> Tensor:
    """Extend the last two axes of (B, C, H, W) by ``radius`` on each side; ``valid`` does not change them."""
    return image if border == "valid" else torch.nn.functional.pad(image, (radius,) * 4, mode=PAD_MODES[border])


def extended(image: Tensor, rows: tuple[int, int], columns: tuple[int, int], border: str) -> Tensor:
    """Return rows and columns of an image that reach beyond it, however far; ``valid`` repeats what nobody looks at.

    Args:
        image: (..., H, W).
        rows: first row, and the one beyond the last.
        columns: the same.
        border: continuation of the image beyond its edges.

    Example:
        >>> extended(torch.arange(3)[None], (0, 1), (-3, 5), "reflect")
        tensor([[1, 2, 1, 0, 1, 2, 1, 0]])
    """
    for axis, (first, last) in ((-2, rows), (-1, columns)):
        side = image.shape[axis]
        at = torch.arange(first, last, device=image.device)
        outside = (at < 0) | (at >= side)
        if border == "reflect":
            period = max(1, 2 * side - 2)
            at = at.remainder(period)
            at = torch.minimum(at, period - at)
        elif border == "circular":
            at = at.remainder(side)
        image = image.index_select(axis, at.clamp(0, side - 1))
        if border == "zero":
            shape = (-1, 1) if axis == -2 else (-1,)
            image = image * (~outside).to(image.dtype).view(shape)
    return image


def cropped(tensor: Tensor, margin: int) -> Tensor:
    """Return a map without so many pixels on each side.

    Example:
        >>> cropped(torch.zeros(3, 8, 9), 2).shape
        torch.Size([3, 4, 5])
    """
    return tensor[..., margin : tensor.shape[-2] - margin, margin : tensor.shape[-1] - margin]


def transform_side(pixels: int) -> int:
    """Return the samples that an axis is transformed as: even, as odd numbers take twice as long."""
    return 2 * next_fast_size(-(-pixels // 2))


def to_spectrum(planes: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the half spectrum of (..., H, W) planes, filled up with zeros so that planes of ``size`` transform fast.

    Image and PSF are both given the padded image's ``size``; the product of their spectra goes to
    :func:`from_spectrum`. On a CPU the spectrum is transposed: columns are transformed in one piece of memory, and
    rows of zeros not at all.
    """
    height, width = transform_side(size[0]), transform_side(size[1])
    if planes.device.type != "cpu":
        return torch.fft.rfft2(planes, s=(height, width))
    return torch.fft.fft(torch.fft.rfft(planes, n=width).mT, n=height)


def from_spectrum(product: Tensor, size: tuple[int, int], psf_size: int) -> Tensor:
    """Return the convolution: the pixels of a padded plane of ``size`` that see the whole PSF.

    The first ``psf_size - 1`` rows and columns hold what wrapped around.
    """
    height, width = transform_side(size[0]), transform_side(size[1])
    rows, columns = slice(psf_size - 1, size[0]), slice(psf_size - 1, size[1])
    if product.device.type != "cpu":
        return torch.fft.irfft2(product, s=(height, width))[..., rows, columns]
    return torch.fft.irfft(torch.fft.ifft(product)[..., rows].mT, n=width)[..., columns]
