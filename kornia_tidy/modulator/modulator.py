"""Modulators: the phase states shown during one exposure, their times and their fractions of the light."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_part, described, printed
from kornia_tidy.mode import refuse_torchscript


class Timeline(NamedTuple):
    r"""Sequence of phase states during one exposure: M moments, each with one or several states.

    A moment has several states where the light divides, as into the diffracted and the undiffracted light of a
    grating. Both parts image the scene at the same time. A state may occur in several moments.

    Args:
        states: (S, N, N) radians.
        durations: (M,) duration of each moment as a fraction of the exposure, summing to one. The first K moments are
            those of the K masks, in their order; transitions between masks follow.
        mixture: (M, S) fraction of a moment's light in each state, each row summing to one. None: M = S, and each
            moment has one state.
        middles: (M,) middle of each moment in [0, 1], from the start of the exposure to its end. None: the moments
            follow one another in their order, without a gap.

    Example:
        >>> shown = DiffractionEfficiency(0.75).timeline(torch.zeros(2, 23, 23))
        >>> shown.durations, shown.mixture
        (tensor([0.5000, 0.5000]), tensor([[0.7500, 0.0000, 0.2500],
                [0.0000, 0.7500, 0.2500]]))
        >>> shown.weights, shown.moment_times(), shown.state_times()
        (tensor([0.3750, 0.3750, 0.2500]), tensor([0.2500, 0.7500]), tensor([0.2500, 0.7500, 0.5000]))
    """

    states: Tensor
    durations: Tensor
    mixture: Tensor | None = None
    middles: Tensor | None = None

    @property
    def weights(self) -> Tensor:
        """Fraction of the exposure's light in each state, (S,)."""
        return self.durations if self.mixture is None else (self.durations[:, None] * self.mixture).sum(0)

    def moment(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the states of one moment, (S', N, N), and their weights, (S',), which sum to one."""
        if self.mixture is None:
            return self.states[index : index + 1], torch.ones_like(self.durations[:1])
        present = self.mixture[index].nonzero()[:, 0]
        return self.states[present], self.mixture[index, present]

    def moment_times(self) -> Tensor:
        """Return the middle of each moment as a fraction of the exposure, (M,)."""
        return self.durations.cumsum(0) - self.durations / 2 if self.middles is None else self.middles

    def state_times(self) -> Tensor:
        """Return the mean time of each state's light as a fraction of the exposure, (S,); 1/2 if it has no light."""
        times = self.moment_times()
        if self.mixture is None:
            return times
        light = self.durations[:, None] * self.mixture
        return torch.where(self.weights > 0, (light * times[:, None]).sum(0) / self.weights, 0.5)

    def with_undiffracted(self, fraction: float) -> Self:
        """Return the timeline with a fraction of the light of every moment moved to a flat state, added as the last."""
        mixture = torch.eye(len(self.states)).to(self.durations) if self.mixture is None else self.mixture
        flat = torch.full_like(self.durations, fraction)[:, None]
        states = torch.cat([self.states, torch.zeros_like(self.states[:1])])
        return self._replace(states=states, mixture=torch.cat([mixture * (1 - fraction), flat], 1))


def timeline_of(modulator: nn.Module, phase: Tensor) -> Timeline:
    """Return the timeline of any modulator.

    Args:
        modulator: a :class:`Modulator`, or any module that returns states and weights. The latter gives no times, so
            its states follow one another in their order.
        phase: masks, (K, N, N) radians.
    """
    if torch.jit.is_tracing():
        refuse_torchscript()
    return modulator.timeline(phase) if isinstance(modulator, Modulator) else Timeline(*modulator(phase))


class Modulator(nn.Module):
    """Base class of modulators: converts masks to the timeline of an exposure. A subclass implements :meth:`timeline`.

    Shape:
        - input: phase (K, N, N) radians.
        - output: states (S, N, N) radians and weights (S,), which sum to one.
    """

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the states shown for these masks, with their times and weights.

        Args:
            phase: (K, N, N) radians.
        """
        raise NotImplementedError

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown for these masks, (S, N, N) radians, and their weights, (S,)."""
        shown = self.timeline(phase)
        return shown.states, shown.weights


class DwellTimes(Modulator):
    """An ideal modulator: it shows each mask for its dwell time and switches without delay.

    Args:
        shares: relative dwell time of each mask; normalised to sum to one. Default: equal.

    Shape:
        - input: phase (K, N, N) radians.
        - output: states (S, N, N) radians and weights (S,), which sum to one. Here S = K.

    Raises:
        ValueError: if a share is negative or not finite, or all are zero; on use, if there are not as many as masks, or
            no mask.
        TypeError: if ``shares`` is not a sequence of numbers.

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
        if shares is not None and not (any(shares) and all(0 <= s < math.inf for s in shares)):
            raise ValueError(f"dwell shares must be finite, not negative and not all zero, got {tuple(shares)}")
        self.shares = None if shares is None else _normalised(shares)

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the masks one after another, each for its dwell time."""
        masks = phase.shape[0]
        if masks == 0:
            raise ValueError(f"phase must hold at least one mask, got the shape {tuple(phase.shape)}")
        if self.shares is None:
            return Timeline(phase, phase.new_full((masks,), 1 / masks))
        _check_count(len(self.shares), masks)
        return Timeline(phase, phase.new_tensor(self.shares))

    def extra_repr(self) -> str:
        """Return a one-line description of the dwell times."""
        return "equal dwell times" if self.shares is None else f"dwell shares {tuple(round(s, 4) for s in self.shares)}"


class LearnableDwellTimes(Modulator):
    r"""Dwell times that are learnt with the masks, :math:`w_k = e^{a_k} / \sum_j e^{a_j}`: positive, summing to one.

    Args:
        shares: initial relative dwell times, one for each mask, all positive.

    Shape:
        - ``logits``: learnable parameter (K,).
        - input: phase (K, N, N) radians; output: states (K, N, N) and weights (K,).

    Raises:
        ValueError: if a share is not positive and finite; on use, if there are not as many as masks.
        TypeError: if ``shares`` is not a sequence of numbers.

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

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments of the class that follow from the parameters of a state."""
        return {"shares": parameters["logits"].double().softmax(0).tolist()}

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the masks one after another, each for its learnt dwell time."""
        _check_count(len(self.logits), phase.shape[0])
        return Timeline(phase, self.logits.to(phase).softmax(0))

    def extra_repr(self) -> str:
        """Return a one-line description of the dwell times."""
        return f"learnable dwell shares {printed(self.logits.softmax(0), 4)}"


class DiffractionEfficiency(Modulator):
    """Diffraction efficiency: only a fraction of the light is modulated by the masks, the rest passes a flat state.

    The undiffracted light is added in intensity, as a state that lasts for the whole exposure. Several masks have
    equal dwell times. For other dwell times make this a part of a :class:`SpatialLightModulator`.

    Args:
        efficiency: fraction of the light that the masks modulate, above 0 and at most 1.

    Shape:
        - input: phase (K, N, N) radians; output: states (K + 1, N, N), the last flat, and weights (K + 1,).

    Raises:
        ValueError: if the efficiency is out of range.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), with 0.7.

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

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the masks one after another for equal times, each together with the flat state."""
        return DwellTimes().timeline(phase).with_undiffracted(1 - self.efficiency)

    def extra_repr(self) -> str:
        """Return a one-line description of the efficiency."""
        return f"{self.efficiency:.0%} of the light is modulated"


class SpatialLightModulator(Modulator):
    """A spatial light modulator (SLM) composed of parts: the errors of its panel and its switching between masks.

    Args:
        parts: modules, applied in this order. Panel parts convert masks (K, N, N) to masks as the panel shows them,
            such as :class:`~kornia_tidy.modulator.phase_panel.GreyLevels` and
            :class:`~kornia_tidy.modulator.phase_panel.PixelCrosstalk`. One timing part gives states and weights, such
            as :class:`DwellTimes` or :class:`~kornia_tidy.modulator.switching.Switching`. Panel parts after it act on
            all its states, transitions included. A :class:`DiffractionEfficiency` may have any position, and can
            replace the timing part: then, as without any part, dwell times are equal.
        fill_factor: fraction of each pixel's area that modulates, a square in its middle. Light through the gaps
            between the squares keeps phase zero; see :func:`~kornia_tidy.psf.exact.exact_psf_bank`.

    Shape:
        - input: phase (K, N, N) radians; output: states (S, N, N) radians and weights (S,).

    Raises:
        ValueError: if the fill factor is not in (0, 1].
        TypeError: if a part is not a module; on use, if panel parts come without a timing part or a
            :class:`DiffractionEfficiency`, or if there are two timing parts.

    Convention:
        - The panel does not modulate undiffracted light, so that light stays flat whatever the position of the
          :class:`DiffractionEfficiency`.
        - Any module that maps phase to states and weights can serve as a modulator. Without an attribute
          ``fill_factor`` it has no gaps.

    Example:
        >>> from kornia_tidy.modulator.phase_panel import GreyLevels
        >>> from kornia_tidy.modulator.switching import Switching
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

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the states that the panel shows for these masks, with their times and weights."""
        shown: Tensor | Timeline = phase
        efficiencies = [part for part in self.parts if isinstance(part, DiffractionEfficiency)]
        for part in self.parts:
            if part not in efficiencies:
                shown = self._apply_part(part, shown)
        if isinstance(shown, Tensor):
            if not efficiencies:
                raise TypeError(
                    "a part of a modulator must give states and weights, as DwellTimes and Switching do, got "
                    f"{self._names()}"
                )
            shown = DwellTimes().timeline(shown)
        for part in efficiencies:
            shown = shown.with_undiffracted(1 - part.efficiency)
        return shown

    def _apply_part(self, part: nn.Module, shown: Tensor | Timeline) -> Tensor | Timeline:
        """Apply one part to the masks, or to the timeline once a timing part has given one."""
        if isinstance(shown, Tensor):
            if isinstance(part, Modulator):
                return part.timeline(shown)
            result = part(shown)
            return Timeline(*result) if isinstance(result, tuple) else result
        if isinstance(part, Modulator) or not isinstance(states := part(shown.states), Tensor):
            raise TypeError(
                f"one part of a modulator may give states and weights, as DwellTimes or Switching do, got "
                f"{self._names()}: give dwell times as Switching(..., dwell=...)"
            )
        return shown._replace(states=states)

    def _names(self) -> list[str]:
        return [type(part).__name__ for part in self.parts]

    def extra_repr(self) -> str:
        """Return a one-line description of the fill factor."""
        return f"fill factor {self.fill_factor:g}"


def _check_numbers(shares: object) -> None:
    if shares is not None and not (isinstance(shares, Sequence) and all(isinstance(s, int | float) for s in shares)):
        raise TypeError(f"dwell shares must be a number for each mask, such as (3, 1), got {described(shares)}")


def _normalised(shares: Sequence[float]) -> tuple[float, ...]:
    """Return shares that sum to one; those near the largest float are divided first, so that no sum is infinite."""
    relative = [s / max(shares) for s in shares]
    return tuple(s / sum(relative) for s in relative)


def _check_count(shares: int, masks: int) -> None:
    if shares != masks:
        raise ValueError(f"dwell shares must be one for each of the {masks} masks, got {shares}")
