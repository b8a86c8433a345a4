"""Detection of point sources in a picture, their centres, and the background around them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.psf.psf_bank import enclosing_window

MOST_SAMPLES = 100_000  # of a picture, from which its background is estimated
FITS = 8  # of a plane to the background, each without the outliers of the one before


def find_points(image: Tensor, count: int, window: int) -> list[tuple[int, int]]:
    """Detect the brightest points of a picture, brightest first.

    Args:
        image: (H, W) linear light.
        count: number of points.
        window: side in pixels of the square that a point's light fills. Other points lie outside of it.

    Returns:
        Row and column of the pixel at the centre of each point's light.

    Raises:
        ValueError: if the picture is smaller than the window, or has no room for that many points.

    Example:
        >>> image = torch.zeros(32, 48)
        >>> image[10, 12], image[20, 40] = 1.0, 2.0
        >>> find_points(image, 2, 9)
        [(20, 40), (10, 12)]
    """
    check_float_tensor("image", image, 2, "(H, W)")
    check_positive("count", count)
    height, width = image.shape
    if window > min(height, width):
        raise ValueError(f"a window of {window} pixels does not fit into a picture of {height}x{width}")
    # A plane, so that a gradient of the background is not taken for a point at the edge of the picture.
    rows, columns = (torch.linspace(-1, 1, length, dtype=torch.float64, device=image.device) for length in image.shape)
    basis = torch.stack(torch.broadcast_tensors(torch.ones_like(image).double(), rows[:, None], columns))
    every = max(1, image.numel() // MOST_SAMPLES)
    factors, _ = _plane(basis.flatten(1)[:, ::every], image.double().flatten()[None, ::every])
    value = image.double() - torch.einsum("ci,ihw->hw", factors, basis)
    # A box of half the window collects enough light. Two passes give a peak where one would give a plateau.
    box = max(1, window // 4) * 2 + 1
    smooth = value[None, None]
    for _ in range(2):
        smooth = avg_pool2d(smooth, box, 1, box // 2)
    light = smooth[0, 0].clone()
    found = []
    for _ in range(count):
        place = int(light.argmax())
        row, column = divmod(place, width)
        if not bool(light[row, column].isfinite()):
            raise ValueError(f"a picture of {height}x{width} has no room for {count} points of {window} pixels")
        found.append((row, column))
        light[max(0, row - window) : row + window + 1, max(0, column - window) : column + window + 1] = -torch.inf
    return found


def annulus_background(image: Tensor, centre: tuple[float, float], inner: float, outer: float) -> tuple[Tensor, Tensor]:
    r"""Return the background around a point: a plane through the pixels of an annulus, without outliers.

    .. math:: b(r, c) = b_0 + b_r r + b_c c

    A lamp beside the point or vignetting leaves a gradient. The plane is fitted by least squares, and values farther
    from it than three standard deviations, estimated by the median absolute deviation, are rejected, eight times over.

    Args:
        image: (C, H, W) linear light.
        centre: row and column of the annulus' centre.
        inner: inner radius in pixels.
        outer: outer radius in pixels.

    Returns:
        (C, H, W) the plane at each pixel of the picture, and (C,) the variance of its value at the centre, from the
        scatter of the annulus.

    Raises:
        ValueError: if fewer than 32 pixels are within the picture.

    Example:
        >>> image = torch.full((1, 32, 32), 0.1) + 1e-3 * torch.arange(32)
        >>> image[0, 16, 16], image[0, 4, 16] = 1.0, 0.7
        >>> background, _ = annulus_background(image, (16, 16), 10, 14)
        >>> background[0, 16, 14:19]
        tensor([0.1140, 0.1150, 0.1160, 0.1170, 0.1180])
    """
    rows = torch.arange(image.shape[-2], dtype=torch.float64, device=image.device) - centre[0]
    columns = torch.arange(image.shape[-1], dtype=torch.float64, device=image.device) - centre[1]
    radius = torch.hypot(rows[:, None], columns)
    within = (radius >= inner) & (radius <= outer)
    ring = image[:, within].double()
    if ring.shape[1] < 32:
        raise ValueError(
            f"the background needs 32 pixels between {inner:g} and {outer:g} px of a point at row {centre[0]:.0f}, "
            f"column {centre[1]:.0f}, the picture of {image.shape[-2]}x{image.shape[-1]} has {ring.shape[1]}"
        )
    basis = torch.stack(torch.broadcast_tensors(torch.ones_like(radius), rows[:, None] / outer, columns / outer))
    factors, variance = _plane(basis[:, within], ring)
    return torch.einsum("ci,ihw->chw", factors, basis).to(image.dtype), variance


def light_around(image: Tensor, centre: tuple[int, int], window: int) -> Tensor:
    """Return the mean light (C,) between a window and the circle with the window's side as its radius.

    Args:
        image: (C, H, W), background subtracted.
        centre: row and column of the pixel at the centre.
        window: side of the window in pixels, odd.

    Example:
        >>> image = torch.ones(1, 21, 21)
        >>> image[:, 6:15, 6:15] = 9.0
        >>> light_around(image, (10, 10), 9)
        tensor([1.])
    """
    rows, columns = (
        (torch.arange(length, device=image.device) - at).abs()
        for at, length in zip(centre, image.shape[-2:], strict=True)
    )
    outside = (rows[:, None] > window // 2) | (columns > window // 2)
    return image[:, outside & (torch.hypot(rows[:, None].double(), columns.double()) < window)].mean(1)


def _plane(at: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Fit planes to values (C, n) without outliers, where the basis is ``at``, (3, n).

    Returns:
        The factors (C, 3), and the variance (C,) of the first of them from the scatter about the plane.
    """
    kept, rounding = torch.ones_like(values), 1e-12 * values.abs().amax(1, keepdim=True)
    for _ in range(FITS):
        normal = torch.einsum("cn,in,jn->cij", kept, at, at)
        factors = torch.linalg.solve(normal, torch.einsum("cn,in,cn->ci", kept, at, values))
        deviation = (values - factors @ at).abs()
        spread = deviation.median(1, keepdim=True).values.maximum(rounding)
        kept = (deviation <= 3 * 1.4826 * spread).double()
    scatter = (kept * deviation.square()).sum(1) / kept.sum(1)
    return factors, scatter * torch.linalg.inv(torch.einsum("cn,in,jn->cij", kept, at, at))[:, 0, 0]


def centre_of_light(image: Tensor, start: tuple[int, int], window: int) -> tuple[float, float]:
    r"""Return the centroid of the light in a window that is re-centred on it, over all channels together.

    .. math:: c = \sum_p p \, y_p \Big/ \sum_p y_p

    Args:
        image: (C, H, W), background subtracted; noise may make values negative.
        start: row and column near the centroid.
        window: side in pixels, odd.

    Returns:
        Row and column.

    Raises:
        ValueError: if the window leaves the picture or has no light.

    Convention:
        - The centroid of the light is not the position of the chief ray. With a symmetric aperture defocus does not
          move the centroid, but a mask does, and so does light cropped by the window.

    Example:
        >>> image = torch.zeros(1, 9, 9)
        >>> image[0, 4, 4], image[0, 4, 5] = 3.0, 1.0
        >>> centre_of_light(image, (4, 4), 5)
        (4.0, 4.25)
    """
    light = image.double().sum(0)
    row, column = start
    for _ in range(10):
        part = cut_out(light, (row, column), window)
        total = part.sum()
        if not bool(total > 0):
            raise ValueError(f"there is no light in the {window}x{window} pixels about row {row}, column {column}")
        steps = torch.arange(window, dtype=torch.float64, device=light.device) - window // 2
        centre = float(row + (part.sum(1) @ steps) / total), float(column + (part.sum(0) @ steps) / total)
        nearest = round(centre[0]), round(centre[1])
        if nearest == (row, column):
            break
        row, column = nearest
    return centre


def centre_of_symmetry(image: Tensor, start: tuple[int, int], window: int) -> tuple[float, float]:
    """Return the centre of a symmetric spot: its centroid under a Gaussian weight that is re-centred on it.

    The Gaussian is as wide as the light, so the noise of a wide window has little weight. Unlike a window of whole
    pixels it ends exactly centred on the light.

    Args:
        image: (C, H, W), background subtracted.
        start: row and column near the centre.
        window: side in pixels, odd, of a square with all the light.

    Returns:
        Row and column.

    Raises:
        ValueError: if the window leaves the picture or has no light.

    Source: Bernstein and Jarvis, The Astronomical Journal 123, 583 (2002), for moments with a matched weight.

    Example:
        >>> x = torch.arange(33.0)
        >>> light = torch.exp(-((x[:, None] - 16.2) ** 2 + (x - 15.7) ** 2) / 8)[None]
        >>> [round(c, 4) for c in centre_of_symmetry(light, (16, 16), 25)]
        [16.2, 15.7]
    """
    coarse = centre_of_light(image, start, window)
    nearest = round(coarse[0]), round(coarse[1])
    light = cut_out(image, nearest, window).double().sum(0)
    half = enclosing_window((light / light.sum())[None], 0.5) or window
    steps = torch.arange(window, dtype=torch.float64, device=light.device) - window // 2
    row, column = coarse[0] - nearest[0], coarse[1] - nearest[1]
    width = max(1.0, half / 2)
    for _ in range(50):
        down, right = (torch.exp(-((steps - at) ** 2) / (2 * width**2)) for at in (row, column))
        weighted = light * down[:, None] * right
        total = weighted.sum()
        # For light as wide as the Gaussian these moments are half the distance to its centre.
        move_down = 2 * float((weighted.sum(1) @ (steps - row)) / total)
        move_right = 2 * float((weighted.sum(0) @ (steps - column)) / total)
        row, column = row + move_down, column + move_right
        if max(abs(move_down), abs(move_right)) < 1e-6:
            break
    return nearest[0] + row, nearest[1] + column


def cut_out(image: Tensor, centre: tuple[int, int], side: int) -> Tensor:
    """Crop a square around a pixel, (..., side, side); the pixel is at index ``side // 2`` of the crop.

    Args:
        image: (..., H, W).
        centre: row and column of the pixel.
        side: side of the square in pixels.

    Raises:
        ValueError: if the square leaves the picture.

    Example:
        >>> cut_out(torch.arange(25).view(5, 5), (2, 3), 3)
        tensor([[ 7,  8,  9],
                [12, 13, 14],
                [17, 18, 19]])
    """
    top, left = centre[0] - side // 2, centre[1] - side // 2
    height, width = image.shape[-2:]
    if min(top, left) < 0 or top + side > height or left + side > width:
        raise ValueError(
            f"the {side}x{side} pixels about row {centre[0]}, column {centre[1]} leave the picture of {height}x{width}"
        )
    return image[..., top : top + side, left : left + side]
