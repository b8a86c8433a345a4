"""Files of the networks that are shipped: without the state of their runs, eight bits a weight."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.reconstruction.eight_bits import EightBits
from kornia_tidy.reconstruction.half_precision import halved
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.reconstruction.trained import load_trained

LEVELS = 127  # on either side of zero


def in_eight_bits(weights: Mapping[str, Tensor], names: Collection[str]) -> dict[str, Any]:
    r"""Return weights of a network in which those of convolutions are :class:`EightBits`, others float16.

    The error of a weight is at most 1/254 of the largest of its output channel. Others, such as biases, factors and
    convolutions to one channel, are few; see :func:`~kornia_tidy.reconstruction.half_precision.halved` for their error.

    Args:
        weights: by name.
        names: of the weights to convert: parameters of networks, not PSFs or masks, which need float32.

    Raises:
        ValueError: if a weight is not finite, or one of the others beyond the range of float16, 65504.
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


def ship(checkpoint: str | os.PathLike[str], path: str | os.PathLike[str], *, short: bool = True) -> None:
    """Write a checkpoint for shipping: without the state of the run, the network's weights in eight bits.

    PSFs of a closed form are left out: :func:`~kornia_tidy.reconstruction.trained.load_trained` computes them anew. So
    is the folder of the data, a place on one machine.

    Args:
        checkpoint: file that ``kornia-tidy train`` wrote with a moving average.
        path: of the new file.
        short: write the network's weights as :func:`in_eight_bits` rounds them.
            They are loaded as float32. False: they do not change.

    Raises:
        ValueError: if it is not a checkpoint, has no moving average, or a weight is not finite or too large.
    """
    state = read_state(checkpoint)
    wanted = ("optics.", "average.network.")
    weights = {name: value for name, value in state["state_dict"].items() if name.startswith(wanted)}
    if not any(name.startswith(wanted[1]) for name in weights):
        raise ValueError(f"{checkpoint} holds no moving average of its network: train it with ema above 0")
    if short:
        parameters = load_trained(checkpoint).head.named_parameters()
        weights = in_eight_bits(weights, [f"{wanted[1]}{name}" for name, _ in parameters])
    weights |= {name: value[..., :0, :0] for name, value in weights.items() if name.endswith("closed_form.psfs")}
    settings = {name: None if name == "root" else value for name, value in state["settings"].items()}
    kept = {name: state[name] for name in ("global_step", "psfs") if name in state}
    write_state(path, {"settings": settings, "state_dict": weights, **kept})
