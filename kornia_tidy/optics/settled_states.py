"""The states of a modulator, read while no other thread changes its masks."""

from __future__ import annotations

import threading

import torch
from torch import Tensor, nn

from kornia_tidy.optics.phase_masks import PhaseMasks

READS = 100  # of masks that another thread changes all the time; what is read last is taken


def settled_states(masks: PhaseMasks, modulator: nn.Module, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return a copy of the states that a modulator shows, and of their weights, as they are at one moment.

    Where other threads run, the parameters are compared before and after, and the states read again if they differ.

    Args:
        masks: the phase masks.
        modulator: turns their phase into states and weights.
        dtype: float32 or float64.

    Returns:
        Radians at 530 nm, (S, rows, columns), and shares of the exposure, (S,). Gradients reach masks and modulator.

    Convention:
        - A thread that is halted in the middle of writing a parameter cannot be told from one that is done. Where that
          matters, let it write through ``load_state_dict`` of the camera, or assign new masks: both are one step.

    Example:
        >>> from kornia_tidy.optics import DwellTimes, PixelwiseMask
        >>> states, weights = settled_states(PixelwiseMask(2), DwellTimes(), torch.float64)
        >>> states.shape, weights
        (torch.Size([2, 23, 23]), tensor([0.5000, 0.5000], dtype=torch.float64))
    """
    alone = threading.active_count() == 1
    for _ in range(READS):
        before = [] if alone else [p.detach().clone() for part in (masks, modulator) for p in part.parameters()]
        states, weights = (shown.clone() for shown in modulator(masks.phase.to(dtype)))
        after = [] if alone else [p for part in (masks, modulator) for p in part.parameters()]
        if all(map(torch.equal, before, after)):
            break
    return states, weights
