"""Eight bits a weight on disk: a network's weights as int8 with a scale for each output channel."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_tidy.reconstruction.half_precision import halved

LEVELS = 127  # on either side of zero


class EightBits(NamedTuple):
    """A weight as whole numbers and a scale, as :func:`kornia_tidy.reconstruction.state_file.write_state` stores it."""

    values: Tensor
    """int8, of the shape of the weight."""
    scale: Tensor
    """float32, one for each output channel, with the axes of the weight."""

    def weight(self) -> Tensor:
        """Return the weight, float32."""
        return self.values * self.scale


def in_eight_bits(weights: Mapping[str, Tensor], names: Collection[str]) -> dict[str, Any]:
    r"""Return weights of a network in which those of convolutions are :class:`EightBits`, others float16.

    The error of a weight is at most 1/254 of the largest of its output channel. Others, such as biases, factors and
    convolutions to one channel, are few; see :func:`~kornia_tidy.reconstruction.half_precision.halved` for their error.

    Args:
        weights: by name.
        names: of the weights to convert: parameters of networks, not PSFs or masks, which need float32.

    Raises:
        ValueError: if a weight is not finite, or one of the others beyond the range of float16, 65504.

    Example:
        >>> weight = torch.tensor([[0.1, -0.4], [3.0, 1.0]]).view(2, 2, 1, 1)
        >>> found = in_eight_bits({"a": weight, "psfs": torch.tensor([0.1])}, {"a"})
        >>> found["a"].values.flatten(1), found["a"].weight().flatten(1), found["psfs"]
        (tensor([[  32, -127],
                [ 127,   42]], dtype=torch.int8), tensor([[ 0.1008, -0.4000],
                [ 3.0000,  0.9921]]), tensor([0.1000]))
    """
    wide = [name for name in names if weights[name].is_floating_point() and weights[name].ndim == 4]
    wide = [name for name in wide if weights[name].shape[0] > 1]  # factors (1, C, 1, 1) are no convolutions
    found: dict[str, Any] = halved(weights, [name for name in names if name not in wide])
    for name in wide:
        weight = weights[name].float()
        if not bool(weight.isfinite().all()):
            raise ValueError(f"{name} is not finite")
        scale = weight.abs().amax((1, 2, 3), keepdim=True) / LEVELS
        values = (weight / scale.where(scale > 0, 1.0)).round().clamp(-LEVELS, LEVELS)  # a tiny scale is rounded
        found[name] = EightBits(values.to(torch.int8), scale)
    return found
