"""Filling of sparse depth along the edges of its image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.optics.holes import fill_holes

# Chosen on five real scenes, with depth known at a third of the pixels of every sixth row. The RMSE of inverse depth
# was 0.45 to 0.74 times that of filling each hole from the nearest known pixel.
SMOOTHNESS = (3.0, 30.0, 300.0, 3000.0)  # lambda of the filter; each fills the pixels that the one before did not reach
COLOR_DEVIATION = 6.0  # of 255; across larger steps of colour little is carried
REACHED = 1e-2  # least weight of known pixels in a filled one
FARTHEST = 1e9  # m; a farther mean is infinity, of whose weight rounding leaves a little


def fill_guided(depth: NDArray[np.float32], known: NDArray[np.bool_], image: Tensor) -> NDArray[np.float32]:
    r"""Fill the holes of a depth map by an edge-preserving average of its known pixels, guided by the image.

    .. math:: z = F(m) / F(m / z_{known})

    with the fast global smoother F, the map of known pixels m, and inverse depth, in which planes are linear.

    Args:
        depth: (H, W) in metres, positive where known, maybe infinite.
        known: (H, W); at least one must be True.
        image: (3, H, W) or (1, H, W) in [0, 1].

    Returns:
        (H, W). Known pixels keep their depth. Pixels out of the smoother's reach get that of the nearest known one.

    Source: Min et al., Fast Global Image Smoothing Based on Weighted Least Squares (TIP 2014), section V-B for
    interpolation of sparse data; the filter is OpenCV's.

    Example:
        >>> import torch
        >>> image = torch.zeros(1, 9, 20)
        >>> image[..., 10:] = 1.0  # an edge
        >>> depth, known = np.ones((9, 20), np.float32), np.zeros((9, 20), bool)
        >>> depth[4, 19], known[4, 0], known[4, 19] = 4.0, True, True
        >>> fill_guided(depth, known, image)[0, 9:11].round(3).tolist()
        [1.0, 4.0]
    """
    if known.all():
        return depth
    guide = np.ascontiguousarray((image.expand(3, -1, -1) * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1])
    near = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)
    filled, _ = fill_holes(np.ma.masked_array(depth, ~known))
    left = ~known
    for smoothness in SMOOTHNESS:
        smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, smoothness, COLOR_DEVIATION)
        weight, sums = smoother.filter(known.astype(np.float32)), smoother.filter(near)
        reached = left & (weight > REACHED)
        mean = sums[reached] / weight[reached]
        filled[reached] = np.divide(1, mean, out=np.full_like(mean, np.inf), where=mean > 1 / FARTHEST)
        left &= ~reached
    return filled
