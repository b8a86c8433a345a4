"""Exponential moving average of a network's weights.

The step is torch's ``get_ema_multi_avg_fn``. Its ``AveragedModel`` copies all buffers, and so fails on the filters of
:class:`~kornia_tidy.reconstruction.Refocused`, whose size follows the PSFs. Lightning's ``WeightAveraging`` averages
the masks too, which the network is not trained for, and stores the average under the network's names.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from kornia_tidy.psf.camera_settings import EXTRA_STATE


class MovingAverage(nn.Module):
    r"""Exponential moving average of a network's weights, held in a copy of the network.

    .. math:: a \leftarrow d_t a + (1 - d_t) w, \quad d_t = \min(d, (1 + t) / (10 + t))

    The decay is small at first, so that the initial weights are soon forgotten. Saved buffers, such as the statistics
    of batch normalisation, are copied.

    Args:
        network: the original, which is not changed.
        decay: d, in [0, 1).

    Raises:
        ValueError: if the decay is not allowed.

    Example:
        >>> network = nn.Linear(1, 1)
        >>> average = MovingAverage(network, 0.999)
        >>> with torch.no_grad():
        ...     _ = network.weight.add_(1.0)
        >>> average.update(network)  # the first step has a decay of 1/10
        >>> round(float(network.weight.detach() - average.network.weight), 6)
        0.1
    """

    steps: Tensor

    def __init__(self, network: nn.Module, decay: float = 0.999) -> None:
        super().__init__()
        if not 0 <= decay < 1:
            raise ValueError(f"the decay of a moving average must be in [0, 1), got {decay}")
        self.decay = decay
        self.network = copy.deepcopy(network).requires_grad_(requires_grad=False)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    def update(self, network: nn.Module) -> None:
        """Move the average towards the network's present weights by one step."""
        steps = int(self.steps)
        step = get_ema_multi_avg_fn(min(self.decay, (1 + steps) / (10 + steps)))
        learnt = dict(network.named_parameters())
        if learnt:
            step(list(self.network.parameters()), list(learnt.values()), steps)
        own = self.network.state_dict()
        others = {
            name: value
            for name, value in network.state_dict().items()
            if name not in learnt and not name.endswith(EXTRA_STATE) and not torch.equal(value, own[name])
        }  # settings have no average
        if others:  # of PSFs that were loaded kernels are computed again, which takes as long as a sixth of a step
            self.network.load_state_dict(others, strict=False)  # modules may take buffers of another size
        self.steps += 1

    def forward(self, *inputs: Tensor, **options: Any) -> Tensor:
        """Return the output of the averaged network."""
        return self.network(*inputs, **options)
