"""Properties of a raw capture and of its picture in words."""

from __future__ import annotations

from torch import Tensor

from kornia_tidy.lab.raw.capture import RawCapture, RawInfo
from kornia_tidy.lab.raw.color import ASSUMED_CAMERA
from kornia_tidy.lab.raw.develop import balance_factors, default_method, matrix_origin

FLIPS = {
    0: "is upright",
    1: "is mirrored left to right",
    2: "is mirrored top to bottom",
    3: "is to be turned by 180 degrees",
    4: "is mirrored at its diagonal",
    5: "is to be turned by 90 degrees counter-clockwise",
    6: "is to be turned by 90 degrees clockwise",
    7: "is mirrored at its other diagonal",
}


def raw_in_words(raw: RawCapture) -> list[tuple[str, str]]:
    """Return the properties of a capture as topics and texts.

    Example:
        >>> import torch
        >>> counts = torch.tensor([[[64, 164], [264, 1023]]])
        >>> for line in raw_in_words(RawCapture.from_counts(counts, "RGGB", 64, 1023)):
        ...     print(*line)
        camera unknown
        exposure unknown
        sensor 2 x 2 px, filter array RGGB
        levels black 64, white 1023; counts 64 to 1023, 25 % of them at white or above
        colour white balance unknown; no colour matrix
        picture is upright
    """
    height, width = raw.counts.shape[-2:]
    linear = f"linear {raw.colors}" if raw.colors else "monochrome"
    colour = f"filter array {raw.pattern_letters}" if raw.pattern else linear
    low, high = (end.item() for end in raw.counts.aminmax())
    ignored = ", ".join(raw.info.ignored_opcodes)
    matrices = [name for name in ("xyz_to_camera", "camera_to_srgb") if getattr(raw, name) is not None]
    aspect = "" if raw.pixel_aspect == 1 else f"; its pixels are {raw.pixel_aspect:.4g} times as wide as high"
    return [
        ("camera", ", ".join(part for part in (raw.info.camera, raw.info.lens) if part) or "unknown"),
        ("exposure", _exposure(raw.info) or "unknown"),
        ("sensor", f"{width} x {height} px, {colour}"),
        (
            "levels",
            f"black {_levels(raw.black)}, white {raw.white:g}; counts {low:.7g} to {high:.7g}, "
            f"{100 * _saturated(raw):.3g} % of them at white or above",
        ),
        ("colour", f"white balance {_balance(raw)}; {' and '.join(matrices) or 'no colour matrix'}"),
        ("picture", FLIPS[raw.flip] + aspect),
        *([("opcodes", f"{ignored}: not applied")] if ignored else []),
    ]


def colors_in_words(raw: RawCapture, demosaic: str | None, balance: str | Tensor | None) -> str:
    """Describe the colour matrix and the white balance of a picture."""
    if not raw.colors:
        return "monochrome"
    factors = balance_factors(raw, balance)
    shown = " ".join(f"{name} {factor:.4g}" for name, factor in zip(raw.colors, factors.tolist(), strict=True))
    method = "no filter array" if raw.pattern is None else demosaic or default_method(raw)
    matrix = {
        "file": "the file's matrix",
        "model": "LibRaw's matrix of the camera",
        "assumed": f"no matrix: that of {ASSUMED_CAMERA} is assumed",
    }[matrix_origin(raw)]
    return f"{method}, white balance {shown}, {matrix}"


def clipped_in_words(image: Tensor) -> str:
    """Describe the share of a linear picture that a file of [0, 1] clips.

    Example:
        >>> import torch
        >>> clipped_in_words(torch.tensor([[[-0.1, 0.5, 1.0, 1.2]]]))
        '25 % of its values lie above white and 25 % below black, and are clipped'
    """
    above, below = (100 * float(share.float().mean()) for share in (image > 1, image < 0))
    return f"{above:.3g} % of its values lie above white and {below:.3g} % below black, and are clipped"


def _exposure(info: RawInfo) -> str:
    parts = []
    if info.exposure:
        short = info.exposure < 0.3
        parts.append(f"1/{1 / info.exposure:.0f} s" if short else f"{info.exposure:.3g} s")
    if info.aperture:
        parts.append(f"f/{info.aperture:.2g}")
    if info.focal_length:
        parts.append(f"{info.focal_length * 1e3:.3g} mm")
    if info.iso:
        parts.append(f"ISO {info.iso:.0f}")
    if info.timestamp:
        parts.append(str(info.timestamp))
    return ", ".join(parts)


def _levels(black: Tensor) -> str:
    """Format black levels: one number if all are equal, else one for each place of the tile."""
    levels = black.flatten().tolist()
    return f"{levels[0]:g}" if len(set(levels)) == 1 else " ".join(f"{level:g}" for level in levels)


def _saturated(raw: RawCapture) -> float:
    return float((raw.counts >= raw.white).float().mean())


def _balance(raw: RawCapture) -> str:
    if raw.white_balance is None:
        return "unknown"
    return " ".join(f"{name} {factor:.4g}" for name, factor in zip(raw.colors, raw.white_balance.tolist(), strict=True))
