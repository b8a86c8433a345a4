"""A scene whose alignment survives interpolation and brightness: its depth is the ratio of two channels.

Green over blue is the depth, a ramp. Optics write the depth that they are given, times blue, into red, and red over
blue is then the depth that they used. Interpolation and factors of brightness leave both ratios as they are.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from kornia_tidy.augmentation import DepthAugmentation

HEIGHT, WIDTH = 24, 32
GRADIENT = 0.02  # metres a pixel along the columns, and half of it along the rows
STEP = 1.5 * GRADIENT  # depth between pixels that touch at a corner


class RatioMark(DepthAugmentation):
    """Writes the depth that it is given, times the blue channel, into the red channel.

    Holes, which a rotation leaves 0, have no depth to write: there red is green, so that a later interpolation does not
    mix a mark of 0 into the pixels around. A camera refuses a depth of 0.
    """

    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        mark = torch.where(depth > 0, depth.to(image) * image[:, 2:], image[:, 1:2])
        return torch.cat([mark, image[:, 1:]], 1)


def ratio_scene() -> tuple[Tensor, Tensor]:
    """Image and depth, (2, 3, H, W) and (2, 1, H, W)."""
    x, y = torch.arange(WIDTH), torch.arange(HEIGHT)[:, None]
    depth = (0.1 + GRADIENT * (x + y / 2)).expand(2, 1, HEIGHT, WIDTH).contiguous()
    return torch.cat([torch.zeros_like(depth), depth, torch.ones_like(depth)], 1), depth


def assert_ratios(image: Tensor, depth: Tensor, marked: bool, warps: int) -> None:
    """Each of ``warps`` moves by a pixel at most: nearest and linear resampling round half a pixel, each its way.

    A pixel of the result may be two of the scene, where a warp halves it.
    """
    assert image.shape[-2:] == depth.shape[-2:]
    known = (depth > 0)[:, 0] & (image[:, 2] > 0.25)
    if not known.any():
        return
    bound = STEP * 2 * max(warps, 1)
    seen = image[:, :2] / image[:, 2:]
    errors = [(seen[:, 1] - depth[:, 0])[known].abs().max()]
    if marked:
        errors.append((seen[:, 0] - seen[:, 1])[known].abs().max())
    assert max(errors) < bound, [float(error) for error in errors]
