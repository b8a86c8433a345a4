"""Developing: a raw capture as an RGB picture."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor
from torch.nn.functional import interpolate

from kornia_tidy.checks import check_choice, check_finite
from kornia_tidy.raw.auto_balance import auto_balance
from kornia_tidy.raw.color import adapted_to_srgb, assumed_camera_to_srgb, camera_to_srgb
from kornia_tidy.raw.demosaic import BAYER, demosaic_to_srgb, mixed
from kornia_tidy.raw.filter_array import tiled

if TYPE_CHECKING:
    from kornia_tidy.raw.capture import RawCapture

HIGHLIGHTS = ("clip", "keep")
WHITE_BALANCES = ("as shot", "daylight", "auto", "none")


def develop(
    raw: RawCapture,
    method: str | None = None,
    white_balance: str | Tensor | None = None,
    highlights: str = "clip",
    adaptation: str | None = None,
    matrix: Tensor | None = None,
    encoded: bool = True,
    square_pixels: bool = True,
    upright: bool = True,
) -> Tensor:
    """Return the picture of a raw capture.

    Levels are taken out and white balance is put in before demosaicing, the camera's matrix after it; nothing else is
    done: no brightening, no sharpening, no denoising.

    Args:
        raw: the capture.
        method: of :func:`~kornia_tidy.raw.demosaic.demosaic`, for captures behind a filter array. Default: that of
            :func:`default_method`.
        white_balance: ``"as shot"``, ``"daylight"``, ``"auto"``, see
            :func:`~kornia_tidy.raw.auto_balance.auto_balance`, or ``"none"``, or factors, one a channel of
            ``raw.colors`` or one a colour. Default: as shot if the file says it, else daylight if it says that, else
            none.
        highlights: a channel that is multiplied by more saturates higher. ``"clip"`` takes all to the lowest of these
            levels, which becomes 1: what is saturated is white. ``"keep"`` leaves what is above 1, in false colours
            where a channel is saturated.
        adaptation: chromatic adaptation, see :func:`~kornia_tidy.raw.color.adapted_to_srgb`. Default: none but
            the white balance in the camera's channels, as LibRaw.
        matrix: from balanced colours to linear sRGB, (3, colours). Default: the capture's own or, where it has none
            and its filters are R, G and B, that of
            :func:`~kornia_tidy.raw.color.assumed_camera_to_srgb`.
        encoded: sRGB encoding; False is linear.
        square_pixels: stretch pixels that are not square, linearly, along their shorter side's direction.
        upright: turn the picture as the camera was held.

    Returns:
        (3, H, W) float32; (1, H, W) of a monochrome sensor, whose values have neither balance nor matrix.

    Raises:
        ValueError: if the capture lacks what is asked for, or an argument is none of the above.

    Warns:
        UserWarning: if daylight is taken because the file does not say its white balance, and nobody asked for it.

    Convention:
        Black is 0, noise below it negative; colours that sRGB cannot show lie outside [0, 1]. Neither is clamped.

    Example:
        >>> from kornia_tidy.raw.capture import RawCapture
        >>> counts = torch.tensor([[[300, 500], [500, 800]]]).repeat(1, 2, 2)
        >>> raw = RawCapture.from_counts(counts, "RGGB", black=100, white=1100)
        >>> develop(raw, "bilinear", matrix=torch.eye(3), encoded=False)[:, 1, 1]
        tensor([0.2000, 0.4000, 0.7000])
    """
    check_choice("highlights", highlights, HIGHLIGHTS)
    mosaic = raw.mosaic()
    to_srgb = None
    if raw.colors:
        if white_balance is None and raw.white_balance is None and raw.daylight_balance is not None:
            warnings.warn(
                "a file without a white balance as shot is balanced for daylight, which leaves a cast in other light: "
                "choose white_balance='auto' (--white-balance auto), or 'daylight' if it was",
                stacklevel=2,
            )
        factors = balance_factors(raw, white_balance)
        _balance(mosaic, raw, factors / factors.min())
        to_srgb = srgb_matrix(raw, factors, adaptation) if matrix is None else _checked(matrix, raw)
    if highlights == "clip":
        mosaic.clamp_(max=1)
    if to_srgb is None:
        image = mosaic
    elif raw.pattern is None:
        image = mixed(mosaic, to_srgb)
    else:
        image = demosaic_to_srgb(mosaic, raw.pattern, raw.colors, method or default_method(raw), to_srgb)
    if square_pixels and raw.pixel_aspect != 1:
        image = squared(image, raw.pixel_aspect)
    if encoded:
        image = encode(image)
    return raw.upright(image) if upright else image


def default_method(raw: RawCapture) -> str:
    """Return how a capture is demosaiced if nobody says: LibRaw's AHD or, for X-Trans, Markesteijn's; else bilinear."""
    letters = raw.pattern_letters or ""
    if letters in BAYER:
        return "libraw_ahd"
    return "libraw_markesteijn" if len(letters) == 36 else "bilinear"


def balance_factors(raw: RawCapture, white_balance: str | Tensor | None = None) -> Tensor:
    """Return the white balance of a capture, one factor for each channel of ``raw.colors``.

    Args:
        raw: the capture.
        white_balance: as for :func:`develop`.

    Raises:
        ValueError: if the file does not say it, nothing in the capture tells it (``"auto"``), or given factors are
            not positive, or not as many as channels or colours.
    """
    none = torch.ones(len(raw.colors))
    if white_balance is None:
        stated = raw.daylight_balance if raw.white_balance is None else raw.white_balance
        return none if stated is None else stated
    if isinstance(white_balance, str):
        check_choice("white_balance", white_balance, WHITE_BALANCES)
        if white_balance == "auto":
            return auto_balance(raw)
        factors = {"as shot": raw.white_balance, "daylight": raw.daylight_balance, "none": none}[white_balance]
        if factors is None:
            raise ValueError(f"the capture has no white balance {white_balance!r}: choose another or give factors")
        return factors
    check_finite("white_balance", white_balance)
    names = "".join(dict.fromkeys(raw.colors))
    if white_balance.shape == (len(names),):
        white_balance = white_balance[[names.index(letter) for letter in raw.colors]]
    if white_balance.shape != none.shape or not bool((white_balance > 0).all()):
        raise ValueError(
            f"white_balance must be {len(names)} positive factors, of {', '.join(names)}, got {white_balance.tolist()}"
        )
    return white_balance.to(none)


def srgb_matrix(raw: RawCapture, factors: Tensor, adaptation: str | None = None) -> Tensor:
    """Return the matrix (3, colours) from a capture's balanced colours to linear sRGB.

    Args:
        raw: the capture.
        factors: its white balance, as :func:`balance_factors` returns it.
        adaptation: as for :func:`develop`.

    Raises:
        ValueError: if the filters are not R, G and B and nothing is known of them.
    """
    names = "".join(dict.fromkeys(raw.colors))
    first = [raw.colors.index(letter) for letter in names]
    origin = matrix_origin(raw)
    if origin == "file" and raw.camera_to_srgb is not None:
        matrix = raw.camera_to_srgb
        daylight = torch.ones(len(names)) if raw.daylight_balance is None else raw.daylight_balance[first]
    elif origin == "model" and raw.xyz_to_camera is not None:
        matrix, daylight = camera_to_srgb(raw.xyz_to_camera)
    elif names == "RGB":
        matrix, daylight = assumed_camera_to_srgb()
    else:
        raise ValueError(f"nothing is known of the colours of its filters {names}: give a matrix")
    return matrix if adaptation is None else adapted_to_srgb(matrix, daylight, factors[first], adaptation)


def matrix_origin(raw: RawCapture) -> str:
    """Return whose colour matrix develops a capture: ``"file"``, the camera's ``"model"``, or ``"assumed"``.

    A file's own comes first, as with LibRaw: whoever wrote a DNG knew what was done to its colours.
    """
    if raw.camera_to_srgb is not None:
        return "file"
    return "assumed" if raw.xyz_to_camera is None else "model"


def encode(image: Tensor) -> Tensor:
    """Return linear light, (3, H, W) or (1, H, W), in sRGB's encoding; not clamped, negative light stays negative."""
    return linear_rgb_to_rgb(image.expand(3, -1, -1))[: len(image)]


def squared(image: Tensor, pixel_aspect: float) -> Tensor:
    """Return (C, H, W) with square pixels: more columns if a pixel is wider than high, else more rows.

    Args:
        image: to be stretched, linearly, about its middle.
        pixel_aspect: width of a pixel over its height.
    """
    height, width = image.shape[-2:]
    size = (height, round(width * pixel_aspect)) if pixel_aspect > 1 else (round(height / pixel_aspect), width)
    return interpolate(image[None], size=size, mode="bilinear", align_corners=False)[0]


def _balance(mosaic: Tensor, raw: RawCapture, factors: Tensor) -> None:
    """Multiply every channel of a mosaic, in place, by its factor."""
    if raw.pattern is None:
        mosaic *= factors[:, None, None]
        return
    rows = raw.tile[0]
    for row, gains in enumerate(tiled(factors[torch.tensor(raw.pattern)], rows, mosaic.shape[-1])):
        mosaic[:, row::rows] *= gains


def _checked(matrix: Tensor, raw: RawCapture) -> Tensor:
    colors = len(set(raw.colors))
    if matrix.shape != (3, colors):
        raise ValueError(f"matrix must have shape (3, {colors}), got {tuple(matrix.shape)}")
    return matrix
