"""A learnable aperture: the amplitude of each mask pixel as a parameter, as of a liquid-crystal shutter."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kornia_tidy.masks.limits import clamped
from kornia_tidy.optics.aperture import check_aperture


class LearnableAperture(nn.Module):
    """The amplitude over the masks' pixels as a parameter.

    Args:
        amplitude: the parameter: one amplitude for all masks, or one for each.

    Shape:
        - amplitude: (N, N) or (K, N, N), or finer by a whole factor.
        - output: the same, in [0, 1].

    Raises:
        TypeError: if the amplitude is not a real floating-point parameter.
        ValueError: if its shape does not fit, a value is outside [0, 1] or NaN, or a mask has no open pixel.

    Convention:
        - A step of an optimiser may leave [0, 1]. The amplitude is clamped to it, and beyond an end gradients pass only
          where descent leads back, as of masks with the constraint ``"clamp"``.
        - PSFs are shares of the light that passes: a smaller aperture makes no picture darker. Of several amplitudes,
          the one that passes more light has more of the exposure.

    Example:
        >>> aperture = LearnableAperture(nn.Parameter(torch.full((23, 23), 0.5)))
        >>> aperture().shape, [name for name, _ in aperture.named_parameters()]
        (torch.Size([23, 23]), ['amplitude'])
    """

    def __init__(self, amplitude: nn.Parameter) -> None:
        super().__init__()
        if not isinstance(amplitude, nn.Parameter) or not amplitude.is_floating_point():
            found = amplitude.dtype if isinstance(amplitude, nn.Parameter) else type(amplitude).__name__
            raise TypeError(f"a learnable aperture must be an nn.Parameter of real floating-point numbers, got {found}")
        check_aperture(amplitude.detach(), amplitude.shape[-1] if amplitude.ndim else 1)
        self.amplitude = amplitude

    def forward(self) -> Tensor:
        """Return the amplitude, clamped to [0, 1]."""
        return clamped(self.amplitude, 1.0)

    def extra_repr(self) -> str:
        """Describe the aperture."""
        *masks, rows, columns = self.amplitude.shape
        return f"amplitude of {rows}x{columns} pixels{f' for each of {masks[0]} masks' if masks else ''}"


def check_open(amplitude: Tensor) -> None:
    """Raise ``ValueError`` unless amplitudes are finite and let some light through, those of each mask.

    Args:
        amplitude: (N, N) or (K, N, N), not negative.

    Example:
        >>> check_open(torch.zeros(2, 2))
        Traceback (most recent call last):
        ValueError: aperture must let some light through and be finite, got amplitudes up to 0.0
    """
    brightest = amplitude.detach().flatten(-2).amax(-1)
    if not bool(((brightest > 0) & brightest.isfinite()).all()):
        found = float(brightest.nan_to_num(torch.nan, torch.inf).min())
        raise ValueError(f"aperture must let some light through and be finite, got amplitudes up to {found}")
