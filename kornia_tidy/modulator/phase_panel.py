"""The panel of a phase modulator: what it shows when it is asked for a mask. Grey levels, stroke, crosstalk."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from kornia_tidy.checks import check_positive


def level_phases(bits: int, phase_range: float = 2 * math.pi) -> Tensor:
    r"""Return the phases of a panel with a straight response, :math:`g \, \Phi / 2^b` for grey levels g = 0 to 2^b - 1.

    Args:
        bits: bits b of the grey levels, 1 to 10.
        phase_range: :math:`\Phi` in radians at 530 nm; with 2π, the level after the last is the first.

    Returns:
        (2^b,) radians, float64.

    Raises:
        ValueError: if bits or range are out of range.

    Example:
        >>> level_phases(2) / math.pi
        tensor([0.0000, 0.5000, 1.0000, 1.5000], dtype=torch.float64)
    """
    if not isinstance(bits, int) or not 1 <= bits <= 10:
        raise ValueError(f"bits must be a whole number from 1 to 10, got {bits}")
    check_positive("phase_range", phase_range, "radians")
    return torch.arange(2**bits, dtype=torch.float64) * (phase_range / 2**bits)


def nearest_level(phase: Tensor, levels: Tensor) -> Tensor:
    """Return the grey level whose phase is nearest, modulo 2π: what is to be written to the panel.

    Args:
        phase: wanted radians, any shape.
        levels: (L,) radians of each grey level, in any order.

    Returns:
        Indices into ``levels``, int64, the shape of ``phase``.

    Example:
        >>> nearest_level(torch.tensor([0.1, 3.0, 6.2, -1.6]), level_phases(2))
        tensor([0, 2, 0, 3])
    """
    turn = 2 * math.pi
    wanted = phase.detach().to(torch.promote_types(phase.dtype, torch.float32)).remainder(turn)
    ascending, order = levels.double().remainder(turn).sort()
    around = torch.cat([ascending[-1:] - turn, ascending, ascending[:1] + turn])
    middles = (around[1:] + around[:-1]) / 2  # levels change here
    place = torch.bucketize(wanted, middles.to(wanted))
    return order.to(phase.device)[(place - 1) % len(order)]


def show_levels(phase: Tensor, levels: Tensor) -> Tensor:
    """Return the phases a panel shows instead of those wanted: for each its nearest level's, modulo 2π.

    Args:
        phase: wanted radians, any shape.
        levels: (L,) radians of each grey level.

    Returns:
        Radians of the levels, the shape and dtype of ``phase``.

    Convention:
        - Gradient: straight through, 1 everywhere.

    Example:
        >>> show_levels(torch.tensor([0.1, 3.0, 6.2]), level_phases(1))
        tensor([0.0000, 3.1416, 0.0000])
    """
    shown = levels.to(phase)[nearest_level(phase, levels)]
    return shown + (phase - phase.detach())  # adds 0, and a gradient of 1


class GreyLevels(nn.Module):
    r"""A panel that shows one of 2^b phases in each pixel: the nearest to the one wanted, modulo 2π.

    With :math:`\Phi = 2\pi` the error is uniform within half a step: its variance is step²/12, and the share
    :math:`\mathrm{sinc}^2(2^{-b})` of the light goes where it should.

    Args:
        bits: bits b of the grey levels, 1 to 10.
        phase_range: phase in radians at 530 nm that the grey levels span. With less than 2π some phases are out of
            reach: the nearer end is shown.
        response: measured phase in radians at 530 nm over grey level, evenly spaced from level 0 to 2^b - 1, straight
            lines between; instead of ``phase_range``. Software that writes through the measured curve is assumed.

    Shape:
        - input and output: (K, N, N) radians.

    Raises:
        ValueError: if bits or range are out of range, or a response has fewer than two samples or one not finite.

    Convention:
        - The phase shown is that of the level: other colours do not see the 2π that 530 nm does not see.
        - Gradient: straight through.

    Source: Goodman, Introduction to Fourier Optics, on binary optics; Dallas, Applied Optics 10, 673 (1971).

    Example:
        >>> GreyLevels(2)(torch.tensor([[[0.1, 1.5], [3.0, 6.2]]])) / math.pi
        tensor([[[0.0000, 0.5000],
                 [1.0000, 0.0000]]])
        >>> GreyLevels(8, response=(0.0, 1.0, 2.5, 6.6)).levels.shape
        torch.Size([256])
    """

    levels: Tensor

    def __init__(
        self, bits: int, phase_range: float = 2 * math.pi, response: Sequence[float] | Tensor | None = None
    ) -> None:
        super().__init__()
        self.bits, self.phase_range, self.response = bits, phase_range, None
        levels = level_phases(bits, phase_range)
        if response is not None:
            curve = torch.as_tensor(response, dtype=torch.float64)
            if curve.ndim != 1 or len(curve) < 2 or not bool(torch.isfinite(curve).all()):
                raise ValueError(
                    f"a measured response must have at least two finite phases in radians, got {curve.tolist()}"
                )
            place = torch.linspace(0, len(curve) - 1, len(levels), dtype=torch.float64)
            lower = place.long().clamp(max=len(curve) - 2)
            levels = torch.lerp(curve[lower], curve[lower + 1], place - lower)
            self.response = tuple(curve.tolist())
        # Not a buffer: module.to(float16) must not round what a panel does.
        self.levels = levels

    def forward(self, phase: Tensor) -> Tensor:
        """Return the masks as the panel shows them."""
        return show_levels(phase, self.levels)

    def frames(self, phase: Tensor) -> Tensor:
        """Return the grey levels to write to the panel, (K, N, N) int64."""
        return nearest_level(phase, self.levels)

    def extra_repr(self) -> str:
        """Describe the panel in a person's words."""
        return f"{self.bits} bits, {float(self.levels.min()):.2f} to {float(self.levels.max()):.2f} rad at 530 nm"


class StrokeError(nn.Module):
    r"""A panel whose phase is off by a factor everywhere, :math:`\phi \mapsto g \phi`: drive voltage or temperature.

    Args:
        gain: g, 1 for no error.

    Shape:
        - input and output: (K, N, N) radians. Put :class:`GreyLevels` before it: what is off is the phase within the
          panel's range, not multiples of 2π it never shows.

    Raises:
        ValueError: if the gain is not positive and finite.

    Example:
        >>> StrokeError(0.95)(torch.ones(1, 1, 1)).item()
        0.949999988079071
    """

    def __init__(self, gain: float) -> None:
        super().__init__()
        check_positive("gain", gain)
        self.gain = gain

    def forward(self, phase: Tensor) -> Tensor:
        """Return the masks as the panel shows them."""
        return phase * self.gain

    def extra_repr(self) -> str:
        """Describe the error in a person's words."""
        return f"stroke times {self.gain:g}"


def crosstalk_kernel(sigma: float) -> Tensor:
    r"""Return what the neighbours of a pixel along one axis share in its phase.

    Phase is a staircase over the pixels, blurred by a Gaussian and averaged over each pixel again:

    .. math:: w_d = G(d + 1) - 2 G(d) + G(d - 1), \quad
        G(x) = x \, \Phi(x/\sigma) + \frac{\sigma}{\sqrt{2\pi}} e^{-x^2 / 2\sigma^2}

    Args:
        sigma: standard deviation of the Gaussian in pixels.

    Returns:
        (2 r + 1,) float64, summing to one, with r the first pixel beyond six standard deviations.

    Example:
        >>> crosstalk_kernel(0.25)
        tensor([1.7863e-06, 9.9732e-02, 8.0053e-01, 9.9732e-02, 1.7863e-06],
               dtype=torch.float64)
    """
    check_positive("sigma", sigma, "pixels")
    reach = math.ceil(6 * sigma)
    x = torch.arange(-reach - 1, reach + 2, dtype=torch.float64)
    integral = x * torch.special.ndtr(x / sigma) + sigma / math.sqrt(2 * math.pi) * torch.exp(-((x / sigma) ** 2) / 2)
    kernel = integral.diff(n=2)
    return kernel / kernel.sum()


class PixelCrosstalk(nn.Module):
    """A panel whose pixels pull at their neighbours: fringing fields blur the phase. See :func:`crosstalk_kernel`.

    It blurs what is shown, steps of 2π too: put it after :class:`GreyLevels`. Pixels keep one phase each: that the
    blur also rounds the edges within a pixel is left out.

    Args:
        sigma: standard deviation of the blur in pixels.

    Shape:
        - input and output: (K, N, N) radians; beyond the border the outermost pixels go on.

    Raises:
        ValueError: if sigma is not positive and finite.

    Source: Persson, Engström and Goksör, Optics Express 20(20) 22334 (2012).

    Example:
        >>> PixelCrosstalk(0.25)(torch.eye(3)[None]).round(decimals=2)
        tensor([[[0.8200, 0.1700, 0.0100],
                 [0.1700, 0.6600, 0.1700],
                 [0.0100, 0.1700, 0.8200]]])
    """

    def __init__(self, sigma: float) -> None:
        super().__init__()
        self.sigma = sigma
        self.kernel = crosstalk_kernel(sigma)  # not a buffer: as GreyLevels

    def forward(self, phase: Tensor) -> Tensor:
        """Return the masks as the panel shows them."""
        kernel = self.kernel.to(phase)
        reach = len(kernel) // 2
        wide = pad(phase[:, None], (reach,) * 4, mode="replicate")
        rows = conv2d(wide, kernel[None, None, None, :])
        return conv2d(rows, kernel[None, None, :, None])[:, 0]

    def extra_repr(self) -> str:
        """Describe the blur in a person's words."""
        return f"sigma {self.sigma:g} pixels"
