"""The exponential moving average of a network's weights, which is steadier than the network in training."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from kornia_tidy.psf.camera_settings import EXTRA_STATE


class MovingAverage(nn.Module):
    r"""A copy of a network whose weights follow those of the original slowly.

    .. math:: a \leftarrow d_t a + (1 - d_t) w, \quad d_t = \min(d, (1 + t) / (10 + t))

    The smaller decay at first lets it forget where the network began. Saved buffers, such as the statistics of
    batch normalisation, are copied.

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

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Take a step towards the network's weights."""
        steps = int(self.steps)
        decay = min(self.decay, (1 + steps) / (10 + steps))
        learnt = {name for name, _ in network.named_parameters()}
        for (name, own), new in zip(self.network.state_dict().items(), network.state_dict().values(), strict=True):
            if name.endswith(EXTRA_STATE):  # settings, of which there is no average
                continue
            if name in learnt:
                own.lerp_(new, 1 - decay)
            else:
                own.copy_(new)
        self.steps += 1

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return what the averaged network does."""
        return self.network(*inputs)
