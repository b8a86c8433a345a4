"""Eight bits a weight on disk: a network's weights as int8 with a scale for each output channel."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class EightBits(NamedTuple):
    """A weight as whole numbers and a scale, as :func:`kornia_tidy.reconstruction.state_file.write_state` stores it."""

    values: Tensor
    """int8, of the shape of the weight."""
    scale: Tensor
    """float32, one for each output channel, with the axes of the weight."""

    def weight(self) -> Tensor:
        """Return the weight, float32."""
        return self.values * self.scale
