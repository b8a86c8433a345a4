"""Raw development: white balance, demosaicing and colour conversion of a raw capture into an RGB picture."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor
from torch.nn.functional import interpolate

from kornia_tidy.checks import check_choice, check_finite
from kornia_tidy.lab.raw.auto_balance import auto_balance
from kornia_tidy.lab.raw.color import assumed_camera_to_srgb, camera_to_srgb
from kornia_tidy.lab.raw.demosaic import BAYER, demosaic, mixed
from kornia_tidy.lab.raw.filter_array import is_xtrans, tiled

if TYPE_CHECKING:
    from kornia_tidy.lab.raw.capture import RawCapture

HIGHLIGHTS = ("clip", "keep")
WHITE_BALANCES = ("as shot", "daylight", "auto", "none")


def develop(
    raw: RawCapture,
    method: str | None = None,
    white_balance: str | Tensor | None = None,
    highlights: str = "clip",
    matrix: Tensor | None = None,
    encoded: bool = True,
    square_pixels: bool = True,
    upright: bool = True,
) -> Tensor:
    """Develop a raw capture into a picture.

    Black and white levels and the white balance are applied before demosaicing, the colour matrix after it. The
    picture is not brightened, sharpened or denoised.

    Args:
        raw: the capture.
        method: of :func:`~kornia_tidy.lab.raw.demosaic.demosaic`, for captures behind a filter array. Default: that of
            :func:`default_method`.
        white_balance: ``"as shot"``, ``"daylight"``, ``"auto"`` (see
            :func:`~kornia_tidy.lab.raw.auto_balance.auto_balance`), ``"none"``, or factors, one for each channel of
            ``raw.colors`` or one for each colour. Default: as shot if the file has it, else daylight if the file has
            that, else none.
        highlights: white balance raises the saturation level of a channel by its factor. ``"clip"`` clips all channels
            to the lowest of these levels, which becomes 1, so that saturated pixels are white. ``"keep"`` keeps values
            above 1; where a channel is saturated, their colours are false.
        matrix: from balanced colours to linear sRGB, (3, colours). Default: the capture's own or, if it has none and
            its filters are R, G and B, that of :func:`~kornia_tidy.lab.raw.color.assumed_camera_to_srgb`.
        encoded: apply the sRGB encoding; False returns linear light.
        square_pixels: resample pictures of non-square pixels, linearly, to more columns or more rows.
        upright: rotate and mirror the picture upright.

    Returns:
        (3, H, W) float32; (1, H, W) for a monochrome sensor, without white balance and colour matrix.

    Raises:
        ValueError: if the capture lacks the white balance or the matrix asked for, or an argument is invalid.

    Warns:
        UserWarning: if daylight is chosen by default because the file has no white balance as shot.

    Convention:
        Black is 0 and noise around it may be negative. Colours out of sRGB's gamut lie outside [0, 1]. Nothing but
        the highlights is clamped.

    Example:
        >>> from kornia_tidy.lab.raw.capture import RawCapture
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
        to_srgb = srgb_matrix(raw) if matrix is None else _checked(matrix, raw)
    if highlights == "clip":
        mosaic.clamp_(max=1)
    if to_srgb is None:
        image = mosaic
    elif raw.pattern is None:
        image = mixed(mosaic, to_srgb)
    else:
        image = demosaic(mosaic, raw.pattern, raw.colors, method or default_method(raw), to_srgb)
    if square_pixels and raw.pixel_aspect != 1:
        image = squared(image, raw.pixel_aspect)
    if encoded:
        image = encode(image)
    return raw.upright(image) if upright else image


def default_method(raw: RawCapture) -> str:
    """Return the default demosaicing method: LibRaw's AHD for Bayer, Markesteijn for X-Trans, else bilinear."""
    letters = raw.pattern_letters or ""
    if letters in BAYER:
        return "libraw_ahd"
    return "libraw_markesteijn" if is_xtrans(letters) else "bilinear"


def balance_factors(raw: RawCapture, white_balance: str | Tensor | None = None) -> Tensor:
    """Return the white balance of a capture, one factor for each channel of ``raw.colors``.

    Args:
        raw: the capture.
        white_balance: as for :func:`develop`.

    Raises:
        ValueError: if the file lacks it, if it cannot be estimated (``"auto"``), or if given factors are not positive
            or not as many as channels or colours.
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


def srgb_matrix(raw: RawCapture) -> Tensor:
    """Return the matrix (3, colours) from a capture's balanced colours to linear sRGB.

    Raises:
        ValueError: if no matrix is known and the filters are not R, G and B.
    """
    names = "".join(dict.fromkeys(raw.colors))
    origin = matrix_origin(raw)
    if origin == "file" and raw.camera_to_srgb is not None:
        return raw.camera_to_srgb
    if origin == "model" and raw.xyz_to_camera is not None:
        return camera_to_srgb(raw.xyz_to_camera)[0]
    if names == "RGB":
        return assumed_camera_to_srgb()[0]
    raise ValueError(f"the capture has no colour matrix for its filters {names}: give a matrix")


def matrix_origin(raw: RawCapture) -> str:
    """Return the origin of a capture's colour matrix: ``"file"``, the camera's ``"model"``, or ``"assumed"``.

    The matrix of the file comes first, as in LibRaw, since the writer of a DNG may have processed its colours.
    """
    if raw.camera_to_srgb is not None:
        return "file"
    return "assumed" if raw.xyz_to_camera is None else "model"


def encode(image: Tensor) -> Tensor:
    """Encode linear light, (3, H, W) or (1, H, W), as sRGB without clamping; negative light stays negative."""
    return linear_rgb_to_rgb(image.expand(3, -1, -1))[: len(image)]


def squared(image: Tensor, pixel_aspect: float) -> Tensor:
    """Resample an image (C, H, W) to square pixels: more columns for wide pixels, more rows for tall ones.

    Args:
        image: resampled linearly about its centre.
        pixel_aspect: width of a pixel over its height.
    """
    height, width = image.shape[-2:]
    size = (height, round(width * pixel_aspect)) if pixel_aspect > 1 else (round(height / pixel_aspect), width)
    return interpolate(image[None], size=size, mode="bilinear", align_corners=False)[0]


def _balance(mosaic: Tensor, raw: RawCapture, factors: Tensor) -> None:
    """Apply white balance factors to a mosaic in place."""
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
