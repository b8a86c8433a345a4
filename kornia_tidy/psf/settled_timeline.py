"""What a modulator shows, read while no other thread changes its masks."""

from __future__ import annotations

import threading

import torch
from torch import Tensor, nn

from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.modulator.modulator import Timeline, timeline_of

READS = 100  # of masks that another thread changes all the time; what is read last is taken


def settled_timeline(masks: PhaseMasks, modulator: nn.Module, dtype: torch.dtype) -> Timeline:
    """Return a copy of what a modulator shows of masks as they are at one time.

    Where other threads run, the parameters are compared before and after, and the states read again if they differ.

    Args:
        masks: the phase masks.
        modulator: turns their phase into states and weights.
        dtype: float32 or float64.

    Returns:
        States in radians at 530 nm, and when they are shown. Gradients reach masks and modulator.

    Convention:
        - A thread that is halted in the middle of writing a parameter cannot be told from one that is done. Where that
          matters, let it write through ``load_state_dict`` of the camera, or assign new masks: both are one step.

    Example:
        >>> from kornia_tidy.modulator.modulator import DwellTimes
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> shown = settled_timeline(PixelwiseMask(2), DwellTimes(), torch.float64)
        >>> shown.states.shape, shown.weights
        (torch.Size([2, 23, 23]), tensor([0.5000, 0.5000], dtype=torch.float64))
    """
    alone = threading.active_count() == 1
    for _ in range(READS):
        before = [] if alone else [p.detach().clone() for part in (masks, modulator) for p in part.parameters()]
        shown = timeline_of(modulator, masks.phase.to(dtype)).map(Tensor.clone)
        after = [] if alone else [p for part in (masks, modulator) for p in part.parameters()]
        if all(map(torch.equal, before, after)):
            break
    return shown
