"""Switching: the finite transition time between masks, during which the shutter stays open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_number, check_positive
from kornia_tidy.modulator.modulator import DwellTimes, Modulator, Timeline, timeline_of
from kornia_tidy.optics.quadrature import gauss_legendre
from kornia_tidy.optics.units import warn_once

BETWEEN = ("random", "linear", "exponential")
SLOWEST = 10.0  # s; even motors that exchange phase plates are faster
LONG = 5.0  # s; longer exposures are probably milliseconds
MOST_SAMPLES = 1024  # of a transition; a saved camera could ask for more than memory holds
SETTLED = 0.99  # fraction of an exponential response that is complete at the end of the switching time


def check_exposure(exposure: float) -> None:
    """Raise an error unless an exposure is positive, and warn once of one that is probably in milliseconds."""
    check_positive("exposure", exposure, "seconds")
    if exposure > LONG:
        said = f"exposure is {exposure:g} s: if these are milliseconds, give {exposure / 1e3:g}"
        warn_once(None, ("exposure", exposure), said, stacklevel=4)


class Switching(Modulator):
    r"""A modulator with a finite switching time: the capture includes the light of the transitions between masks.

    With S transitions of duration t in an exposure T, mask k is shown for the fraction :math:`s_k (1 - S t / T)` of the
    exposure, where s are the dwell shares, and each transition takes :math:`t / T`. At time u t of a transition, u in
    [0, 1], the state is

    * ``"random"``: one random pattern, each pixel uniform in [0, 2π) at 530 nm, the paper's worst case;
    * ``"linear"``: :math:`\phi_k + u (\phi_{k+1} - \phi_k)`;
    * ``"exponential"``: the same with :math:`1 - e^{-u t/\tau} = 1 - 0.01^u` for u. This is the first-order relaxation
      of a liquid crystal, 99 % complete at the end of the transition, :math:`t = 4.6 \tau`; the last 1 % is neglected.
      A data sheet's rise time from 10 to 90 % is :math:`\ln 9 \, \tau`, so :math:`t = 2.1 \, t_{10-90}`;
    * a measured response for u, as samples evenly spaced over the transition and linear between. It starts at 0 and
      ends at 1; overshoot is allowed.

    Args:
        switching_time: duration t of a transition in seconds.
        exposure: duration T of the exposure in seconds. One above 5 s gets a warning: it may be in milliseconds.
        between: state within a transition, a name or the samples of a measured response.
        dwell: module that gives the dwell shares of the masks, such as :class:`DwellTimes`. Default: equal.
        cyclic: whether the exposure includes the transition from the last mask back to the first.
        samples: Gauss-Legendre points in time for each transition; not used for "random".
        seed: seed of the random patterns. Change it to draw new ones, for example at each training step.

    Shape:
        - input: phase (K, N, N) radians.
        - output: states (S', N, N) radians and weights (S',), which sum to one: the K masks, then the transitions.

    Raises:
        ValueError: if a time is negative or not finite, ``between`` is unknown, or a response has fewer than two
            samples or one that is not finite, or ``samples`` is above 1024; on use, if the transitions take longer than
            the exposure.

    Convention:
        - There are K - 1 transitions, as in the paper: the first mask is set before the shutter opens. A camera whose
          exposures follow each other without a gap also has the transition back: ``cyclic=True`` gives K transitions.
          A single mask has none.
        - Transitions run between the phases as given. Put :class:`~kornia_tidy.modulator.phase_panel.GreyLevels` before
          it to run between the phases that the panel shows.
        - The same seed gives the same patterns at every call, on any device and in any dtype. The global generator is
          neither read nor changed.
        - L1 error of the PSF of a transition between two masks of the paper's noise, against 64 samples (worst of three
          colours and three depths in 41 px): linear 1e-2, 1e-4, 6e-7 and exponential 5e-2, 1e-2, 2e-3 with 4, 6 and 8
          samples. A measured response of 9 samples with an overshoot: 3e-2 with 8 samples, 1e-2 with 12. In a capture
          this error is multiplied by S t / T.
        - The cost grows with the number of states. Five masks have 9 states with random patterns and 37 with 8 samples
          a transition. The PSF bank then takes 1.7 and 4.6 times as long, and its gradients 1.1 and 6.4 times (41 px,
          one core).

    Source: Shah et al., TiDy-PSFs (ICCV 2023), "Modeling State Switching in SLMs", for random states.

    Example:
        >>> states, weights = Switching(8e-3)(torch.zeros(5, 23, 23))
        >>> states.shape, weights[[0, 5]]
        (torch.Size([9, 23, 23]), tensor([0.1360, 0.0800]))
    """

    def __init__(
        self,
        switching_time: float,
        exposure: float = 0.1,
        between: str | Sequence[float] = "random",
        dwell: nn.Module | None = None,
        cyclic: bool = False,
        samples: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_number("switching_time", switching_time, "seconds")
        if not 0 <= switching_time <= SLOWEST:
            raise ValueError(
                f"switching_time must be zero or positive seconds up to {SLOWEST:g} (4 ms is 4e-3), got "
                f"{switching_time}"
            )
        check_exposure(exposure)
        check_positive("samples", samples)
        if samples > MOST_SAMPLES:
            raise ValueError(f"samples must be at most {MOST_SAMPLES} points in time for a transition, got {samples}")
        if isinstance(between, str):
            check_choice("between", between, BETWEEN)
        else:
            between = tuple(float(value) for value in between)
            if len(between) < 2 or not all(map(math.isfinite, between)):
                raise ValueError(f"a measured response must have at least two finite samples, got {between}")
        self.switching_time, self.exposure, self.between = switching_time, exposure, between
        self.dwell = DwellTimes() if dwell is None else dwell
        self.cyclic, self.samples, self.seed = cyclic, samples, seed

    def timeline(self, phase: Tensor) -> Timeline:
        """Return the masks and the transitions between them, with their times and weights.

        Example:
            >>> shown = Switching(20e-3).timeline(torch.zeros(3, 5, 5))
            >>> shown.durations, shown.moment_times()
            (tensor([0.2000, 0.2000, 0.2000, 0.2000, 0.2000]), tensor([0.1000, 0.5000, 0.9000, 0.3000, 0.7000]))
        """
        dwell = timeline_of(self.dwell, phase)
        if dwell.mixture is not None:
            raise ValueError(
                f"dwell must show one state after another, got {type(self.dwell).__name__}, which shows some at once: "
                f"make it and Switching two parts of a SpatialLightModulator"
            )
        masks, shares = dwell.states, dwell.durations
        count = len(masks) if self.cyclic and len(masks) > 1 else len(masks) - 1
        duration = self.switching_time / self.exposure
        if count * duration > 1 + 1e-9:
            raise ValueError(
                f"{count} transitions of {self.switching_time * 1e3:g} ms must fit into the exposure of "
                f"{self.exposure * 1e3:g} ms, got {count * self.switching_time * 1e3:g} ms"
            )
        if count * duration == 0:
            return dwell
        if self.between == "random":
            between, weights = random_phases(self.seed, count, *phase.shape[-2:]).to(phase), phase.new_ones(1)
            inside = phase.new_full((1,), 0.5)
        else:
            response, weights = (values.to(phase) for values in sampled_response(self.between, self.samples))
            before, after = masks[:count], masks.roll(-1, 0)[:count]
            between = torch.lerp(before, after, response[:, None, None, None]).flatten(0, 1)
            inside = (gauss_legendre(self.samples)[0] + 0.5).to(phase)
        shown = shares * max(0.0, 1 - count * duration)
        ends = shown.cumsum(0) + duration * torch.arange(len(masks), device=shown.device, dtype=shown.dtype)
        middles = torch.cat([ends - shown / 2, (ends[:count] + duration * inside[:, None]).flatten()])
        durations = torch.cat([shown, (weights[:, None] * duration).expand(-1, count).flatten()])
        return Timeline(torch.cat([masks, between]), durations, middles=middles)

    def extra_repr(self) -> str:
        """Return a one-line description of the transitions."""
        between = self.between if isinstance(self.between, str) else f"measured ({len(self.between)} samples)"
        return (
            f"{self.switching_time * 1e3:g} ms a transition in an exposure of {self.exposure * 1e3:g} ms, "
            f"{between} between{', cyclic' if self.cyclic else ''}"
        )


def sampled_response(between: str | Sequence[float], samples: int) -> tuple[Tensor, Tensor]:
    """Return the response of a transition at the points of a Gauss-Legendre rule in time, and the rule's weights.

    Args:
        between: ``"linear"``, ``"exponential"`` or evenly spaced samples of a measured response.
        samples: number of points of the rule.

    Returns:
        Response (0 at the first mask, 1 at the next) and weights, (samples,) float64 each; the weights sum to one.

    Example:
        >>> sampled_response((0.0, 1.2, 1.0), 1)
        (tensor([1.2000], dtype=torch.float64), tensor([1.], dtype=torch.float64))
    """
    nodes, weights = gauss_legendre(samples)
    time = nodes + 0.5
    if between == "linear":
        return time, weights
    if between == "exponential":
        return 1 - (1 - SETTLED) ** time, weights
    curve = torch.tensor(cast("Sequence[float]", between), dtype=torch.float64)
    position = time * (len(curve) - 1)
    lower = position.long().clamp(max=len(curve) - 2)
    return torch.lerp(curve[lower], curve[lower + 1], position - lower), weights


def random_phases(seed: int, count: int, rows: int, columns: int) -> Tensor:
    """Return random phase patterns, uniform in [0, 2π), (count, rows, columns) float64.

    The same arguments give the same patterns; NumPy's generator is seeded at each call.

    Example:
        >>> torch.equal(random_phases(3, 2, 23, 23), random_phases(3, 2, 23, 23))
        True
    """
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 2 * math.pi, (count, rows, columns)))


# torch.compile cannot trace NumPy's generator, so the result is marked as a constant, as in optics/quadrature.py.
setattr(random_phases, "_dynamo_marked_constant", True)  # noqa: B010
