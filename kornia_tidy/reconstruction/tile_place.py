"""Position of a tile in its image, on which interpolation with ``align_corners=True`` depends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode


class TilePlace(TorchFunctionMode):
    r"""Context in which a network interpolates a tile as it would the whole image.

    Interpolation with ``align_corners=True`` maps the first and last pixel of the whole image onto themselves, so

    .. math:: x = i \, \frac{n - 1}{m - 1}

    for pixel i of m computed from n. For twofold interpolation the step is not exactly 1/2, so that the weights change
    over the image, and a tile needs n, m and i of the image. Other layers do not depend on position.

    Args:
        tile: rows and columns of the tile.
        corner: row and column of the image at which the tile begins.
        image: rows and columns of the image.

    Convention:
        - Rounding is PyTorch's: indices are in float32 for all types but float64.
        - Features must be smaller than the tile by an integer factor, and be enlarged by an integer factor.

    Example:
        >>> image = torch.arange(8.0).square().view(1, 1, 1, 8).expand(1, 1, 8, 8)
        >>> double = torch.nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True)
        >>> with TilePlace((4, 4), (0, 4), (8, 8)):
        ...     tile = double(image[..., :4, 4:])
        >>> bool((tile - double(image)[..., :8, 8:]).abs()[..., 2:-2].max() < 1e-5)
        True
    """

    def __init__(self, tile: tuple[int, int], corner: tuple[int, int], image: tuple[int, int]) -> None:
        super().__init__()
        self.axes = tuple(zip((-2, -1), tile, corner, image, strict=True))

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Replace interpolation by that for the tile's position; call all other functions unchanged."""
        kwargs = kwargs or {}
        if func is not functional.interpolate or not kwargs.get("align_corners"):
            return func(*args, **kwargs)
        features: Tensor = args[0]
        if kwargs.get("mode") != "bilinear" or kwargs.get("antialias"):
            raise ValueError(f"a tile of an image can be interpolated with align_corners=True bilinearly, not {kwargs}")
        wanted = func(features[:1, :1].to("meta"), *args[1:], **kwargs).shape
        for axis, tile, start, whole in self.axes:
            size = features.shape[axis]
            if tile % size or wanted[axis] % size:
                raise ValueError(
                    f"a tile is interpolated at whole factors: its {tile} pixels are {size}, to be {wanted[axis]}"
                )
            step, factor = tile // size, wanted[axis] // size
            features = _stretched(features, axis, factor, start // step, whole // step)
        return features


def _stretched(features: Tensor, axis: int, factor: int, start: int, whole: int) -> Tensor:
    """Interpolate one axis of features that are part of ``whole`` and begin at ``start``, as the whole would be."""
    size = features.shape[axis]
    precise = torch.promote_types(features.dtype, torch.float32)
    index = torch.arange(factor * start, factor * (start + size), device=features.device, dtype=precise)
    scale = torch.tensor(whole - 1, dtype=precise) / max(1, factor * whole - 1)
    place = index * scale.to(features.device)
    before = place.floor()
    # Values beyond the ends of the tile are wrong; the caller discards them.
    first = (before.long() - start).clamp(0, size - 1)
    second = (before.long() + 1).clamp(max=whole - 1).sub(start).clamp(0, size - 1)
    weight = (place - before).to(features.dtype)
    weight = weight[:, None] if axis == -2 else weight
    return torch.lerp(features.index_select(axis, first), features.index_select(axis, second), weight)
