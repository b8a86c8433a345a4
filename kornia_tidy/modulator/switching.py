"""Switching: a modulator takes time from mask to mask, and the shutter is open meanwhile."""

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

BETWEEN = ("random", "linear", "exponential")
SLOWEST = 10.0  # s; what turns a plate by a motor takes less
SETTLED = 0.99  # share of a step done at the end of the switching time, where the response is exponential


class Switching(Modulator):
    r"""A modulator that needs time from each mask to the next; the capture holds the light of the states in between.

    With S swaps of duration t in an exposure T, mask k is shown for :math:`s_k (1 - S t / T)` of it, where s are the
    dwell shares, and each swap takes :math:`t / T`. Within a swap, at time u t with u in [0, 1], it shows

    * ``"random"``: one random pattern, each pixel uniform in [0, 2π) at 530 nm: the paper's worst case;
    * ``"linear"``: :math:`\phi_k + u (\phi_{k+1} - \phi_k)`;
    * ``"exponential"``: the same with :math:`1 - e^{-u t/\tau} = 1 - 0.01^u` for u: first-order relaxation of a liquid
      crystal that has done 99 % when the swap is over, :math:`t = 4.6 \tau`. A data sheet's time from 10 to 90 % is
      :math:`2.2 \tau`: see :func:`settling_time`. The last 1 % of the step is left out;
    * samples of a measured response, evenly spaced over the swap, for u: 0 at its start, 1 at its end, overshoot
      allowed, straight lines between them.

    Args:
        switching_time: duration t of a swap in seconds.
        exposure: duration T of the exposure in seconds.
        between: what is shown within a swap: a name, or the samples of a measured response.
        dwell: dwell shares of the masks, a module like :class:`DwellTimes`. Default: equal.
        cyclic: whether the swap back to the first mask falls into the exposure too.
        samples: Gauss-Legendre points in time for each swap; a random pattern needs none.
        seed: of the random patterns. Other seeds give others; set it to draw anew, in training at each step, say.

    Shape:
        - input: phase (K, N, N) radians.
        - output: states (S', N, N) radians and weights (S',), which sum to one: the K masks, then what is between.

    Raises:
        ValueError: if a time is negative or not finite, the swaps take longer than the exposure, ``between`` is not
            known, or a response has fewer than two samples or one that is not finite.

    Convention:
        - There are K - 1 swaps: the first mask is set before the shutter opens, so that one mask has none, as in the
          paper. A camera whose exposures follow each other without a gap also pays for the way back: ``cyclic=True``
          gives K swaps (and none for one mask).
        - The response moves the phase as it is given: put :class:`~kornia_tidy.modulator.phase_panel.GreyLevels` before
          it, and it moves between the phases that the panel really shows.
        - The same seed gives the same patterns at every call, on any device and in any dtype. The global generator is
          neither read nor changed.
        - Error of the PSF of a swap between two masks of the paper's noise, against 64 samples (L1, worst of three
          colours and three depths in 41 px): linear 1e-2, 1e-4, 6e-7 and exponential 5e-2, 1e-2, 2e-3 with 4, 6 and 8
          samples. A response with an overshoot given by 9 samples: 3e-2 with 8, 1e-2 with 12. In a capture it counts
          times S t / T.
        - Cost: that of its states. Five masks have 9 with random patterns and 37 with 8 samples a swap: the bank takes
          1.7 and 4.6 times as long, with its gradients 1.1 and 6.4 times (41 px, one core).

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
        check_positive("exposure", exposure, "seconds")
        check_positive("samples", samples)
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
        """Return what is shown of these masks, and when: the masks, then what lies between them.

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
        swaps = len(masks) if self.cyclic and len(masks) > 1 else len(masks) - 1
        swap = self.switching_time / self.exposure
        if swaps * swap > 1 + 1e-9:
            raise ValueError(
                f"{swaps} swaps of {self.switching_time * 1e3:g} ms must fit into the exposure of "
                f"{self.exposure * 1e3:g} ms, got {swaps * self.switching_time * 1e3:g} ms"
            )
        if swaps * swap == 0:
            return dwell
        if self.between == "random":
            between, times = random_phases(self.seed, swaps, *phase.shape[-2:]).to(phase), phase.new_ones(1)
            inside = phase.new_full((1,), 0.5)
        else:
            response, times = (values.to(phase) for values in sampled_response(self.between, self.samples))
            before, after = masks[:swaps], masks.roll(-1, 0)[:swaps]
            between = torch.lerp(before, after, response[:, None, None, None]).flatten(0, 1)
            inside = (gauss_legendre(self.samples)[0] + 0.5).to(phase)
        shown = shares * max(0.0, 1 - swaps * swap)
        ends = shown.cumsum(0) + swap * torch.arange(len(masks), device=shown.device, dtype=shown.dtype)
        middles = torch.cat([ends - shown / 2, (ends[:swaps] + swap * inside[:, None]).flatten()])
        durations = torch.cat([shown, (times[:, None] * swap).expand(-1, swaps).flatten()])
        return Timeline(torch.cat([masks, between]), durations, middles=middles)

    def extra_repr(self) -> str:
        """Describe the swaps in a person's words."""
        between = self.between if isinstance(self.between, str) else f"measured ({len(self.between)} samples)"
        return (
            f"{self.switching_time * 1e3:g} ms a swap in an exposure of {self.exposure * 1e3:g} ms, {between} between"
            f"{', cyclic' if self.cyclic else ''}"
        )


def settling_time(rise_time: float) -> float:
    r"""Return the switching time of a first-order liquid crystal from its rise time.

    .. math:: t = \frac{\ln 100}{\ln 9} \, t_{10-90}

    Args:
        rise_time: from 10 to 90 % of a step, in seconds, as data sheets quote it.

    Returns:
        Seconds until 99 % of the step are done.

    Example:
        >>> round(settling_time(5e-3), 5)
        0.01048
    """
    check_positive("rise_time", rise_time, "seconds")
    return rise_time * math.log(1 / (1 - SETTLED)) / math.log(9)


def sampled_response(between: str | Sequence[float], samples: int) -> tuple[Tensor, Tensor]:
    """Return how far a swap has come at the points of a Gauss-Legendre rule in time, and the rule's weights.

    Args:
        between: ``"linear"``, ``"exponential"`` or evenly spaced samples of a measured response.
        samples: points of the rule.

    Returns:
        Response and weights, (samples,) float64 each; the weights sum to one.

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
    place = time * (len(curve) - 1)
    lower = place.long().clamp(max=len(curve) - 2)
    return torch.lerp(curve[lower], curve[lower + 1], place - lower), weights


def random_phases(seed: int, count: int, rows: int, columns: int) -> Tensor:
    """Return random patterns, uniform in [0, 2π): the same for the same arguments, (count, rows, columns) float64.

    Example:
        >>> torch.equal(random_phases(3, 2, 23, 23), random_phases(3, 2, 23, 23))
        True
    """
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 2 * math.pi, (count, rows, columns)))


# Constants to the compiler, which cannot trace NumPy's generator; see propagation.py.
setattr(random_phases, "_dynamo_marked_constant", True)  # noqa: B010
