"""Phase panel: the phase that a panel shows for a wanted mask. Grey levels, phase gain, pixel crosstalk."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from kornia_tidy.checks import check_count, check_positive, unmasked
from kornia_tidy.optics.units import warn_once

WIDEST_CROSSTALK = 1000  # pixels, standard deviation; wider than any panel
_NO_CROSSTALK = 1e-3  # pixels; metres are fewer
SHORT = 3.0  # rad; a smaller span is not a whole wave, and in units of pi panels have it
_WIDEST = 4 * math.pi  # rad; no panel has a longer stroke
_SLACK = 1e-3  # rad beyond 0 to 4 pi, by rounding in a file


def level_phases(bits: int, phase_range: float = 2 * math.pi) -> Tensor:
    r"""Return the phases of a panel with a linear response, :math:`g \, \Phi / 2^b` for grey levels g = 0 to 2^b - 1.

    Args:
        bits: bits b of the grey levels, 1 to 10.
        phase_range: :math:`\Phi` in radians at 530 nm; with 2π the steps continue across the wrap.

    Returns:
        (2^b,) radians, float64.

    Raises:
        ValueError: if bits are out of range, or the range is not positive or above 4π, as in degrees.

    Example:
        >>> level_phases(2) / math.pi
        tensor([0.0000, 0.5000, 1.0000, 1.5000], dtype=torch.float64)
    """
    check_count("bits", bits, most=10)
    check_positive("phase_range", phase_range, "radians")
    if phase_range > _WIDEST + _SLACK:
        raise ValueError(f"phase_range must be at most 4 pi radians, got {phase_range:g}: multiply degrees by pi / 180")
    return torch.arange(2**bits, dtype=torch.float64) * (phase_range / 2**bits)


def check_response(response: Sequence[float] | Tensor, bits: int, lines: Sequence[int] | None = None) -> Tensor:
    """Check the measured phases of a panel's grey levels.

    Args:
        response: radians of the grey levels 0 to 2^b - 1: from 0 to 4π, rising or falling throughout.
        bits: bits b of the panel.
        lines: of the file that has them, for the message.

    Returns:
        The phases, (2^b,) float64.

    Raises:
        ValueError: if there is not one phase for each level, or they leave 0 to 4π by more than 1 mrad, are equal, or
            rise and fall.

    Convention:
        A constant may be added to all phases: it changes no PSF.

    Example:
        >>> check_response([0.0, 90.0, 180.0, 270.0], bits=2)
        Traceback (most recent call last):
        ValueError: a measured response must lie from 0 to 4 pi rad, got 90 at level 1: multiply degrees by pi / 180, \
and do not give drive values for phases
    """
    curve = torch.as_tensor(unmasked("response", response), dtype=torch.float64).detach().cpu()
    if curve.shape != (2**bits,):
        got = len(curve) if curve.ndim == 1 else f"the shape {tuple(curve.shape)}"
        raise ValueError(
            f"a measured response must have {2**bits} phases, one for each level of {bits} bits, got {got}"
        )
    steps = curve.diff() * (1 if curve[-1] >= curve[0] else -1)
    outside = ~((curve >= -_SLACK) & (curve <= _WIDEST + _SLACK))  # True for NaN
    back = torch.cat([steps.new_zeros(1, dtype=torch.bool), steps < 0])
    level = int((outside if bool(outside.any()) else back).long().argmax())
    got = f"got {float(curve[level]):.6g} at level {level}" + (f" (line {lines[level]})" if lines else "")
    if bool(outside.any()):
        remedy = "multiply degrees by pi / 180, and do not give drive values for phases"
        if not curve[level] > 0:
            remedy = "add a constant to all phases, which changes no PSF, and interpolate unknown ones"
        raise ValueError(f"a measured response must lie from 0 to 4 pi rad, {got}: {remedy}")
    if bool(back.any()):
        raise ValueError(
            f"a measured response must rise or fall throughout, {got} after {float(curve[level - 1]):.6g}: smooth "
            f"noise, such as by a fit or np.maximum.accumulate, and undo wraps by np.unwrap"
        )
    if curve[-1] == curve[0]:
        raise ValueError(f"a measured response must rise or fall, got {float(curve[0]):.6g} at every level")
    return curve


def tell_short_span(span: float, bits: int, sentence: str) -> None:
    """Warn, once for each span, of a response that spans much less than a wave, as one in units of waves or pi does.

    Args:
        span: of its phases in radians.
        bits: of its panel.
        sentence: text of the warning.
    """
    if span < SHORT and bits > 1:
        warn_once(None, ("span of a response", span), sentence, stacklevel=4)


def nearest_level(phase: Tensor, levels: Tensor) -> Tensor:
    """Quantise phase to grey levels: return for each value the level of the nearest phase, modulo 2π.

    Args:
        phase: wanted radians, any shape.
        levels: (L,) radians of each grey level, in any order.

    Returns:
        Grey levels as indices into ``levels``, int64, the shape of ``phase``.

    Example:
        >>> nearest_level(torch.tensor([0.1, 3.0, 6.2, -1.6]), level_phases(2))
        tensor([0, 2, 0, 3])
    """
    wave = 2 * math.pi
    wanted = phase.detach().to(torch.promote_types(phase.dtype, torch.float32)).remainder(wave)
    ascending, order = levels.double().remainder(wave).sort()
    extended = torch.cat([ascending[-1:] - wave, ascending, ascending[:1] + wave])
    thresholds = (extended[1:] + extended[:-1]) / 2
    index = torch.bucketize(wanted, thresholds.to(wanted))
    return order.to(phase.device)[(index - 1) % len(order)]


def show_levels(phase: Tensor, levels: Tensor) -> Tensor:
    """Quantise phase to the phases of a panel's grey levels: the nearest, modulo 2π.

    Args:
        phase: wanted radians, any shape.
        levels: (L,) radians of each grey level.

    Returns:
        Phases of the levels in radians, the shape and dtype of ``phase``.

    Convention:
        - The gradient is a straight-through estimate: 1 everywhere.

    Example:
        >>> show_levels(torch.tensor([0.1, 3.0, 6.2]), level_phases(1))
        tensor([0.0000, 3.1416, 0.0000])
    """
    shown = levels.to(phase)[nearest_level(phase, levels)]
    return shown + (phase - phase.detach())  # adds 0, and a gradient of 1


class GreyLevels(nn.Module):
    r"""Quantisation of phase by a panel with 2^b grey levels: each pixel shows the nearest of their phases, modulo 2π.

    With :math:`\Phi = 2\pi` the error is uniform within half a step. Its variance is step²/12, and the diffraction
    efficiency is :math:`\mathrm{sinc}^2(2^{-b})`.

    Args:
        bits: bits b of the grey levels, 1 to 10.
        phase_range: phase :math:`\Phi` in radians at 530 nm that the grey levels span. With less than 2π a phase out
            of range gives the nearer end.
        response: measured phase of each grey level in radians at 530 nm, see :func:`check_response`; it replaces
            ``phase_range``. The frames are assumed to be computed with this curve.

    Shape:
        - input and output: (K, N, N) radians.

    Raises:
        ValueError: if bits or range are out of range, or as :func:`check_response`.

    Convention:
        - The phase shown is the level's own, without the multiples of 2π that were removed from the wanted phase.
          They have no effect at 530 nm but would have one at other wavelengths.
        - The gradient is a straight-through estimate: 1 everywhere.

    Source: Goodman, Introduction to Fourier Optics, on binary optics; Dallas, Applied Optics 10, 673 (1971).

    Example:
        >>> GreyLevels(2)(torch.tensor([[[0.1, 1.5], [3.0, 6.2]]])) / math.pi
        tensor([[[0.0000, 0.5000],
                 [1.0000, 0.0000]]])
        >>> GreyLevels(2, response=(0.0, 1.0, 2.5, 6.6))
        GreyLevels(2 bits, 0.00 to 6.60 rad at 530 nm)
    """

    levels: Tensor

    def __init__(
        self, bits: int, phase_range: float = 2 * math.pi, response: Sequence[float] | Tensor | None = None
    ) -> None:
        super().__init__()
        self.bits, self.phase_range, self.response = bits, phase_range, None
        levels = level_phases(bits, phase_range)
        if response is not None:
            levels = check_response(response, bits)
            span = float(levels.max() - levels.min())
            tell_short_span(span, bits, f"a response spans {span:.3g} rad: multiply waves by 2 pi, degrees by pi / 180")
            self.response = tuple(levels.tolist())
        # Not a buffer, because module.to(float16) must not round the phases of the panel.
        self.levels = levels

    def forward(self, phase: Tensor) -> Tensor:
        """Return the masks quantised to the panel's phases, (K, N, N) radians."""
        return show_levels(phase, self.levels)

    def frames(self, phase: Tensor) -> Tensor:
        """Return the grey levels to write to the panel, (K, N, N) int64."""
        return nearest_level(phase, self.levels)

    def extra_repr(self) -> str:
        """Return a one-line description of the panel."""
        return f"{self.bits} bits, {float(self.levels.min()):.2f} to {float(self.levels.max()):.2f} rad at 530 nm"


class StrokeError(nn.Module):
    r"""Phase gain error of a panel, from a wrong drive voltage or temperature: :math:`\phi \mapsto g \phi`.

    Put :class:`GreyLevels` before it, so that the gain applies to the phase that the panel shows, between 0 and 2π.

    Args:
        gain: factor g, 1 for no error.

    Shape:
        - input and output: (K, N, N) radians.

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
        """Return the masks times the gain, (K, N, N) radians."""
        return phase * self.gain

    def extra_repr(self) -> str:
        """Return a one-line description of the gain."""
        return f"stroke times {self.gain:g}"


def crosstalk_kernel(sigma: float) -> Tensor:
    r"""Return the crosstalk kernel along one axis: the weights of a pixel and its neighbours in the phase shown.

    The phase is piecewise constant over the pixels. It is blurred by a Gaussian and averaged over each pixel:

    .. math:: w_d = G(d + 1) - 2 G(d) + G(d - 1), \quad
        G(x) = x \, \Phi(x/\sigma) + \frac{\sigma}{\sqrt{2\pi}} e^{-x^2 / 2\sigma^2}

    Args:
        sigma: standard deviation of the Gaussian in pixels.

    Returns:
        (2 r + 1,) float64, summing to one, with r six standard deviations, rounded up.

    Raises:
        ValueError: if sigma is not positive, or above 1000.

    Example:
        >>> crosstalk_kernel(0.25)
        tensor([1.7863e-06, 9.9732e-02, 8.0053e-01, 9.9732e-02, 1.7863e-06],
               dtype=torch.float64)
    """
    check_positive("sigma", sigma, "pixels")
    if sigma > WIDEST_CROSSTALK:
        raise ValueError(f"sigma must be at most {WIDEST_CROSSTALK} pixels, got {sigma}")
    if sigma < _NO_CROSSTALK:
        warn_once(
            None, "sigma of crosstalk", f"sigma is {sigma:g} pixels, as if none: divide metres by the pixel pitch"
        )
    reach = math.ceil(6 * sigma)
    x = torch.arange(-reach - 1, reach + 2, dtype=torch.float64)
    integral = x * torch.special.ndtr(x / sigma) + sigma / math.sqrt(2 * math.pi) * torch.exp(-((x / sigma) ** 2) / 2)
    kernel = integral.diff(n=2)
    return kernel / kernel.sum()


class PixelCrosstalk(nn.Module):
    """Pixel crosstalk of a panel: fringing fields blur the phase over neighbouring pixels.

    Put it after :class:`GreyLevels`, so that it blurs the phase shown, jumps of 2π included. The phase stays constant
    over each pixel; its variation within a pixel is neglected. See :func:`crosstalk_kernel`.

    Args:
        sigma: standard deviation of the blur in pixels.

    Shape:
        - input and output: (K, N, N) radians; beyond the border the outermost pixels are repeated.

    Raises:
        ValueError: if sigma is not positive, or above 1000.

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
        self.kernel = crosstalk_kernel(sigma)  # not a buffer, for the reason in GreyLevels

    def forward(self, phase: Tensor) -> Tensor:
        """Return the blurred masks, (K, N, N) radians."""
        kernel = self.kernel.to(phase)
        reach = len(kernel) // 2
        padded = pad(phase[:, None], (reach,) * 4, mode="replicate")
        rows = (padded.unfold(-1, len(kernel), 1) * kernel).sum(-1)  # no convolution: GPUs round those to TF32
        return (rows.unfold(-2, len(kernel), 1) * kernel).sum(-1)[:, 0]

    def extra_repr(self) -> str:
        """Return a one-line description of the blur."""
        return f"sigma {self.sigma:g} pixels"
