"""Fixed-pattern noise: what differs from pixel to pixel of a sensor and is the same in every capture."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_count, check_finite, check_float_tensor, check_generator, check_number

MAPS = "(H, W) or (C, H, W) of the whole sensor, with 1 in the place of H or W where rows or columns are alike"


def draw_pattern(
    height: int,
    width: int,
    *,
    response: float = 0.01,
    dark: float = 0.0,
    columns: float = 0.0,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Draw the fixed pattern of a sensor: a response and an offset for each pixel.

    .. math:: r \sim \mathcal{N}(1, \text{response}^2), \qquad
              o \sim \mathcal{N}(0, \text{dark}^2) + \mathcal{N}(0, \text{columns}^2)_\text{one a column}

    Args:
        height: of the sensor in pixels.
        width: of the sensor in pixels.
        response: photo response non-uniformity (PRNU): standard deviation of the response of pixels, as a share of its
            mean. Usual sensors have 0.003 to 0.02.
        dark: dark signal non-uniformity (DSNU): standard deviation of the offset of pixels in units of full scale.
        columns: standard deviation of the offset of columns, that of their amplifiers, in units of full scale.
        generator: source of random numbers. Default: the global generator.

    Returns:
        Response, and offset in units of full scale, (H, W) float32, as :class:`SensorNoise` takes them.

    Raises:
        ValueError: if a standard deviation is negative, or ``response`` is not below 0.3, beyond which pixels without
            any response would be drawn.

    Source: EMVA Standard 1288, 4.0, section 8 (definitions of PRNU and DSNU); Janesick, Photon Transfer, 2007, ch. 5.

    Example:
        >>> response, offset = draw_pattern(4, 6, response=0.0, columns=1e-3)
        >>> response.unique().tolist(), bool((offset == offset[:1]).all())
        ([1.0], True)
    """
    for name, side in (("height", height), ("width", width)):
        check_count(name, side)
    check_generator(generator)
    for name, value in (("response", response), ("dark", dark), ("columns", columns)):
        check_number(name, value, "as a standard deviation")
        if not 0 <= value < (0.3 if name == "response" else float("inf")):
            limit = "from 0 to 0.3" if name == "response" else "zero or positive and finite"
            raise ValueError(f"{name} must be a standard deviation {limit}, got {value}")
    pixels, darks = (torch.randn(height, width, generator=generator, dtype=torch.float32) for _ in range(2))
    amplifiers = torch.randn(1, width, generator=generator, dtype=torch.float32)
    return (1 + response * pixels).clamp(min=0), dark * darks + columns * amplifiers


def check_pattern(name: str, plane: Tensor | None) -> None:
    """Raise an error unless this is a map of a sensor's pixels, or None.

    Args:
        name: of the argument.
        plane: the map.
    """
    if plane is None:
        return
    check_float_tensor(name, plane, plane.ndim if isinstance(plane, Tensor) and plane.ndim in (2, 3) else 2, MAPS)
    check_finite(name, plane)
    if name == "response" and bool((plane < 0).any()):
        raise ValueError(f"response must not be negative, got {float(plane.min())}")
    if not plane.numel():
        raise ValueError(f"{name} must have at least one pixel, got shape {tuple(plane.shape)}")
    if name == "response" and float(plane.mean()) > 2:
        raise ValueError(f"response must be 1 on average, got {float(plane.mean()):.4g}: divide it by its mean")
    if name == "offset" and float(plane.abs().max()) >= 1:
        raise ValueError(
            f"offset must be in units of full scale, below 1, got {float(plane.abs().max()):.4g}: divide digital "
            f"numbers by those of full scale"
        )


def pattern_at(name: str, plane: Tensor, like: Tensor, origin: tuple[int, int]) -> Tensor:
    """Return the part of a map that an image lies on.

    Args:
        name: of the map, for messages.
        plane: the map, see :data:`MAPS`.
        like: the image, (B, C, h, w).
        origin: row and column of the sensor at its first pixel.

    Raises:
        ValueError: if the image reaches beyond the sensor, or has another number of channels.
    """
    if plane.ndim == 3 and plane.shape[0] not in (1, like.shape[-3]):
        raise ValueError(f"the sensor's {name} has {plane.shape[0]} channels, and the image {like.shape[-3]}")
    for axis, first in ((-2, origin[0]), (-1, origin[1])):
        side, needed = plane.shape[axis], like.shape[axis]
        if side == 1:
            continue
        if first < 0 or first + needed > side:
            raise ValueError(
                f"the sensor's {name} has {tuple(plane.shape[-2:])} pixels, and the image reaches from row and column "
                f"{tuple(origin)} to {(origin[0] + like.shape[-2], origin[1] + like.shape[-1])}: give maps of all of it"
            )
        plane = plane.narrow(axis, first, needed)
    return plane.to(like)
