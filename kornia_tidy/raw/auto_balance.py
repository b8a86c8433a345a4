"""Automatic white balance: factors from the counts of a capture, for files that hold none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from kornia_tidy.raw.capture import RawCapture

NORM = 6  # between 1, grey world, and infinity, where the brightest pixel is white
SATURATED = 0.98  # of white
ENOUGH = 1_000_000  # tiles; of larger captures every second, third, ... row and column


def auto_balance(raw: RawCapture) -> Tensor:
    r"""Return white balance factors that make a capture grey on average, bright parts counting most (shades of grey).

    A channel's level is :math:`(\frac{1}{N} \sum x^6)^{1/6}` over the tiles of the filter array of which nothing is
    saturated; its factor is green's level over its own.

    Args:
        raw: a capture with colours.

    Returns:
        (len(raw.colors),), 1 for green, or for the first channel where none is green.

    Raises:
        ValueError: if a channel sees no light, or something is saturated in every tile.

    Assumes:
        What is bright in the scene is grey on average. A meadow is not: it turns out too pink.

    Source: Finlayson and Trezzi, Shades of gray and colour constancy, CIC 2004, whose best norm is 6.

    Example:
        >>> import torch
        >>> from kornia_tidy.raw.capture import RawCapture
        >>> auto_balance(RawCapture.from_counts(torch.tensor([[[30, 60], [60, 40]]]), "RGGB", black=20, white=1020))
        tensor([4., 1., 2., 1.])
    """
    planes = raw.planes()
    step = max(1, round((planes[0].numel() / ENOUGH) ** 0.5))
    planes = planes[:, ::step, ::step]
    kept = planes[:, (planes < SATURATED).all(0)].clamp(min=0).double()
    if kept.shape[1] == 0:
        raise ValueError("the capture is saturated everywhere, so nothing tells its white balance: give factors")
    letters = raw.pattern_letters or raw.colors
    powers = kept.pow(NORM).mean(1)
    levels = powers.new_tensor(
        [
            sum(p for p, place in zip(powers.tolist(), letters, strict=True) if place == letter) / letters.count(letter)
            for letter in raw.colors
        ]
    ).pow(1 / NORM)
    if not bool((levels > 0).all()):
        raise ValueError("a channel of the capture sees no light, so nothing tells its white balance: give factors")
    return (levels[max(raw.colors.find("G"), 0)] / levels).float()
