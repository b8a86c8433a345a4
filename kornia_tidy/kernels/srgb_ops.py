r"""Decoding and encoding of sRGB: operators in C for processors, and kornia's functions for all else.

.. math::
    L(x) = \begin{cases} x / 12.92 & x \le 0.04045 \\ ((x + 0.055) / 1.055)^{2.4} & \text{else} \end{cases}
    \qquad
    x(L) = \begin{cases} 12.92 \, L & L \le 0.0031308 \\ 1.055 \, L^{1 / 2.4} - 0.055 & \text{else} \end{cases}

Values above 1 go by the power, negative ones by the line. Up to 1 the operators are at most 2e-7 off in float32.

Source: IEC 61966-2-1.
"""

from __future__ import annotations

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, compiled, load
from kornia_tidy.kernels.elementwise import call_elementwise, define_elementwise
from kornia_tidy.mode import Mode, torch_mode

SOURCE = KERNELS / "srgb.c"


def srgb_to_linear(image: Tensor) -> Tensor:
    """Return linear light from an sRGB image, by the operator ``kornia_tidy::srgb`` where it is compiled.

    Args:
        image: floating point, of any shape and on any device.

    Returns:
        Of the same shape, dtype and device. It has gradients, which can be differentiated in turn.

    Example:
        >>> srgb_to_linear(torch.tensor([-1.292, 0.0, 0.5, 1.0, 2.0])).round(decimals=4)
        tensor([-0.1000,  0.0000,  0.2140,  1.0000,  4.9538])
    """
    return _convert(image, encode=False)


def linear_to_srgb(light: Tensor) -> Tensor:
    """Return an sRGB image from linear light, by the operator ``kornia_tidy::srgb`` where it is compiled.

    Args:
        light: floating point, of any shape and on any device.

    Returns:
        Of the same shape, dtype and device. It has gradients, which can be differentiated in turn.

    Example:
        >>> linear_to_srgb(torch.tensor([-0.1, 0.0, 0.2140411, 1.0])).round(decimals=4)
        tensor([-1.2920,  0.0000,  0.5000,  1.0000])
    """
    return _convert(light, encode=True)


def _convert(image: Tensor, encode: bool) -> Tensor:
    traced = torch_mode() & Mode.TRACED  # a compiler fuses torch's own
    here = image.device.type == "cpu" and image.dtype in REALS and not traced
    if here and compiled(SOURCE, image.dtype) is not None:
        return torch.ops.kornia_tidy.srgb(image, encode)
    return _by_torch(image, encode)


def _by_torch(image: Tensor, encode: bool) -> Tensor:
    """Convert by kornia's functions, which want three channels and treat them alike."""
    function = linear_rgb_to_rgb if encode else rgb_to_linear_rgb
    if image.ndim > 2 and image.shape[-3] == 3:
        return function(image)
    return function(image.reshape(1, -1, 1).expand(3, -1, -1))[0].reshape(image.shape)


def _call(out: Tensor, image: Tensor, gradient: Tensor | None, encode: bool) -> Tensor:
    return call_elementwise(load(SOURCE, out.dtype).convert, out, (image, gradient), encode)


define_elementwise("srgb", "Tensor image, bool encode", 1, _call, _by_torch)
