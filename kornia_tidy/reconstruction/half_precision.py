"""Half precision on disk: weights of a network as float16, which loading converts back to float32."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor


def halved(weights: Mapping[str, Tensor], names: Collection[str]) -> dict[str, Tensor]:
    r"""Return weights in which some are float16, with a relative error of at most :math:`2^{-11}`.

    Weights below 6e-5 have an absolute error of at most 3e-8 instead. Tensors of float16 or without floating point are
    unchanged.

    Args:
        weights: by name.
        names: of the weights to convert: parameters of networks, not PSFs or masks, which need float32.

    Raises:
        ValueError: if a weight is beyond the range of float16, 65504.

    Example:
        >>> halved({"a": torch.tensor([0.1]), "psfs": torch.tensor([0.1])}, {"a"})
        {'a': tensor([0.1000], dtype=torch.float16), 'psfs': tensor([0.1000])}
    """
    found = dict(weights)
    for name in names:
        if weights[name].is_floating_point():
            found[name] = weights[name].to(torch.float16)
            if bool((found[name].isfinite() != weights[name].isfinite()).any()):
                largest = float(weights[name].abs().max())
                raise ValueError(f"{name} is beyond the range of float16, 65504: {largest:g}")
    return found
