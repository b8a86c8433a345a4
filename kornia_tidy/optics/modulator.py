"""The modulator: which states it shows during one exposure, and for what share of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_part, described


class DwellTimes(nn.Module):
    """An ideal modulator: it shows each mask for its share of the exposure and switches in no time.

    Args:
        shares: relative dwell time of each mask; scaled to sum to one. Default: equal.

    Shape:
        - input: phase (K, N, N) radians.
        - output: states (S, N, N) radians and weights (S,), which sum to one. Here S = K.

    Raises:
        ValueError: if a share is negative or not finite, all are zero, or their number is not that of the masks.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 4.

    Example:
        >>> import torch
        >>> states, weights = DwellTimes((3, 1))(torch.zeros(2, 23, 23))
        >>> weights
        tensor([0.7500, 0.2500])
    """

    def __init__(self, shares: Sequence[float] | None = None) -> None:
        super().__init__()
        _check_numbers(shares)
        if shares is not None and not (sum(shares) > 0 and all(0 <= s < math.inf for s in shares)):
            raise ValueError(f"dwell shares must be finite, not negative and not all zero, got {tuple(shares)}")
        self.shares = None if shares is None else tuple(s / sum(shares) for s in shares)

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown and their weights."""
        masks = phase.shape[0]
        if self.shares is None:
            return phase, phase.new_full((masks,), 1 / masks)
        _check_count(len(self.shares), masks)
        return phase, phase.new_tensor(self.shares)

    def extra_repr(self) -> str:
        """Describe the exposure in a person's words."""
        return "equal dwell times" if self.shares is None else f"dwell shares {tuple(round(s, 4) for s in self.shares)}"


class LearnableDwellTimes(nn.Module):
    r"""Dwell times that are learnt with the masks, :math:`w_k = e^{a_k} / \sum_j e^{a_j}`: positive, summing to one.

    Args:
        shares: relative dwell times to start from, one for each mask, all positive.

    Shape:
        - ``logits``: learnable parameter (K,).
        - input: phase (K, N, N) radians; output: states (K, N, N) and weights (K,).

    Raises:
        ValueError: if a share is not positive and finite, or their number is not that of the masks.

    Example:
        >>> import torch
        >>> states, weights = LearnableDwellTimes((3, 1))(torch.zeros(2, 23, 23))
        >>> weights
        tensor([0.7500, 0.2500], grad_fn=<SoftmaxBackward0>)
    """

    def __init__(self, shares: Sequence[float]) -> None:
        super().__init__()
        _check_numbers(shares)
        if not shares or not all(0 < s < math.inf for s in shares):
            raise ValueError(f"dwell shares to learn must be positive and finite, got {tuple(shares)}")
        self.logits = nn.Parameter(torch.tensor([math.log(s) for s in shares]))

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown and their weights."""
        _check_count(len(self.logits), phase.shape[0])
        return phase, self.logits.to(phase).softmax(0)

    def extra_repr(self) -> str:
        """Describe the exposure in a person's words."""
        return f"learnable dwell shares {tuple(round(s, 4) for s in self.logits.detach().softmax(0).tolist())}"


class DiffractionEfficiency(nn.Module):
    """A fixed diffractive element: a share of the light sees the masks, the rest passes as if they were flat.

    What a real element does not send where its design says is added as intensity, as a state of its own.

    Args:
        efficiency: share of the light that sees the masks, above 0 and at most 1.

    Shape:
        - input: phase (K, N, N) radians; output: states (K + 1, N, N), the last flat, and weights (K + 1,).

    Raises:
        ValueError: if the efficiency is out of range.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), who take 0.7.

    Example:
        >>> import torch
        >>> states, weights = DiffractionEfficiency(0.7)(torch.rand(1, 23, 23))
        >>> states.shape, weights
        (torch.Size([2, 23, 23]), tensor([0.7000, 0.3000]))
    """

    def __init__(self, efficiency: float) -> None:
        super().__init__()
        if not 0 < efficiency <= 1:
            raise ValueError(f"efficiency must be above 0 and at most 1, got {efficiency}")
        self.efficiency = efficiency

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown and their weights."""
        masks = phase.shape[0]
        weights = phase.new_tensor([self.efficiency / masks] * masks + [1 - self.efficiency])
        return torch.cat([phase, torch.zeros_like(phase[:1])]), weights

    def extra_repr(self) -> str:
        """Describe the element in a person's words."""
        return f"{self.efficiency:.0%} of the light sees the mask"


class SpatialLightModulator(nn.Module):
    """A modulator made of parts: what its panel does to each mask, and how it passes from one to the next.

    Args:
        parts: modules, each taking what the one before gives: first those that turn masks (K, N, N) into masks as the
            panel shows them, such as :class:`~kornia_tidy.optics.phase_panel.GreyLevels` and
            :class:`~kornia_tidy.optics.phase_panel.PixelCrosstalk`; last one that gives states and weights, such as
            :class:`DwellTimes` or :class:`~kornia_tidy.optics.switching.Switching`. Default: equal dwell times.
        fill_factor: share of the area of each pixel that modulates: a square in its middle. Light through the gaps
            between the squares passes with phase zero; see :func:`~kornia_tidy.optics.exact.exact_psf_bank`.

    Shape:
        - input: phase (K, N, N) radians; output: states (S, N, N) radians and weights (S,).

    Raises:
        ValueError: if the fill factor is not in (0, 1].
        TypeError: if the last part does not give states and weights.

    Convention:
        - Any module that maps phase to states and weights is a modulator; without a ``fill_factor``, it has no gaps.

    Example:
        >>> from kornia_tidy.optics.phase_panel import GreyLevels
        >>> from kornia_tidy.optics.switching import Switching
        >>> modulator = SpatialLightModulator(GreyLevels(8), Switching(4e-3), fill_factor=0.93)
        >>> states, weights = modulator(torch.rand(5, 23, 23))
        >>> states.shape, round(float(weights.sum()), 6)
        (torch.Size([9, 23, 23]), 1.0)
    """

    def __init__(self, *parts: nn.Module, fill_factor: float = 1.0) -> None:
        super().__init__()
        if not 0 < fill_factor <= 1:
            raise ValueError(f"fill_factor must be above 0 and at most 1, got {fill_factor}")
        for part in parts:
            check_part("each part of a modulator", part, nn.Module, "a module such as GreyLevels(8) or DwellTimes()")
        self.parts = nn.Sequential(*(parts or (DwellTimes(),)))
        self.fill_factor = fill_factor

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown and their weights."""
        shown = self.parts(phase)
        if not isinstance(shown, tuple):
            raise TypeError(
                "the last part of a modulator must give states and weights, as DwellTimes and Switching do, got "
                f"{[type(part).__name__ for part in self.parts]}"
            )
        return shown

    def extra_repr(self) -> str:
        """Describe the panel in a person's words."""
        return f"fill factor {self.fill_factor:g}"


def _check_numbers(shares: object) -> None:
    if shares is not None and not (isinstance(shares, Sequence) and all(isinstance(s, int | float) for s in shares)):
        raise TypeError(f"dwell shares must be a number for each mask, such as (3, 1), got {described(shares)}")


def _check_count(shares: int, masks: int) -> None:
    if shares != masks:
        raise ValueError(f"there are {shares} dwell shares for {masks} masks")
