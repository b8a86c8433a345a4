"""The modulator: which states it shows during one exposure, and for what share of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn


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
        if shares is not None and not (sum(shares) > 0 and all(0 <= s < math.inf for s in shares)):
            raise ValueError(f"dwell shares must be finite, not negative and not all zero, got {tuple(shares)}")
        self.shares = None if shares is None else tuple(s / sum(shares) for s in shares)

    def forward(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states shown and their weights."""
        masks = phase.shape[0]
        if self.shares is None:
            return phase, phase.new_full((masks,), 1 / masks)
        if len(self.shares) != masks:
            raise ValueError(f"there are {len(self.shares)} dwell shares for {masks} masks")
        return phase, phase.new_tensor(self.shares)

    def extra_repr(self) -> str:
        """Describe the exposure in a person's words."""
        return "equal dwell times" if self.shares is None else f"dwell shares {tuple(round(s, 4) for s in self.shares)}"
