"""Range of the depths of a scene, without its outliers."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def middle_depths(depth: Tensor, valid: Tensor) -> tuple[float, float]:
    """Return the nearest and farthest depth in metres without half a percent of the known pixels at either end.

    Percentiles are taken in dioptres, so that infinite depths are included.

    Args:
        depth: metres, any shape.
        valid: where it is known, same shape.

    Raises:
        ValueError: if the whole scene lies at one depth.

    Example:
        >>> import torch
        >>> middle_depths(torch.tensor([[[1.0, 2.0, 4.0]]]), torch.tensor([[[True, True, False]]]))
        (1.0, 2.0)
    """
    ends = np.quantile(1 / depth[valid].double().numpy(), (0.995, 0.005), method="nearest")
    near, far = (float("inf") if end == 0 else float(1 / end) for end in ends)
    if not near < far:
        raise ValueError(f"a scene with a range of depths is needed, this one lies at {near:.4g} m")
    return near, far
