"""Automatic white balance: factors from the counts of a capture, for files that hold none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from kornia_tidy.lab.raw.capture import RawCapture

NORM = 6  # of the Minkowski mean: 1 assumes a grey world, infinity that the brightest pixel is white
SATURATED = 0.98  # of white
ENOUGH = 1_000_000  # tiles; larger captures are subsampled to about this many


def auto_balance(raw: RawCapture) -> Tensor:
    r"""Return white balance factors that make a capture grey on average, bright parts counting most (shades of grey).

    The level of a channel is :math:`(\frac{1}{N} \sum x^6)^{1/6}` over all tiles of the filter array without a
    saturated pixel. The factor of a channel is the level of green divided by its own level.

    Args:
        raw: a capture with colours.

    Returns:
        (len(raw.colors),), 1 for green, or for the first channel where none is green.

    Raises:
        ValueError: if a channel sees no light, or something is saturated in every tile.

    Assumes:
        The bright parts of the scene are grey on average. For a meadow this is wrong: it turns out too pink.

    Source: Finlayson and Trezzi, Shades of gray and colour constancy, CIC 2004, with 6 as the best norm.

    Example:
        >>> import torch
        >>> from kornia_tidy.lab.raw.capture import RawCapture
        >>> auto_balance(RawCapture.from_counts(torch.tensor([[[30, 60], [60, 40]]]), "RGGB", black=20, white=1020))
        tensor([4., 1., 2., 1.])
    """
    planes = raw.planes()
    step = max(1, round((planes[0].numel() / ENOUGH) ** 0.5))
    planes = planes[:, ::step, ::step]
    kept = planes[:, (planes < SATURATED).all(0)].clamp(min=0).double()
    if kept.shape[1] == 0:
        raise ValueError("the capture is saturated everywhere, so its white balance cannot be estimated: give factors")
    letters = raw.pattern_letters or raw.colors
    powers = kept.pow(NORM).mean(1)
    levels = powers.new_tensor(
        [
            sum(p for p, place in zip(powers.tolist(), letters, strict=True) if place == letter) / letters.count(letter)
            for letter in raw.colors
        ]
    ).pow(1 / NORM)
    if not bool((levels > 0).all()):
        raise ValueError("a channel of the capture is dark, so its white balance cannot be estimated: give factors")
    return (levels[max(raw.colors.find("G"), 0)] / levels).float()
