"""Names of reconstruction networks, as settings and checkpoints give them."""

from __future__ import annotations

import sys

# Each takes in_channels, out_channels and, unless it is in FIXED, width, and maps (B, in_channels, H, W) to
# (B, out_channels, H, W).
HEADS = {
    "attention-unet": "kornia_tidy.reconstruction:AttentionUNet",
    "depth-anything-v2": "kornia_tidy.reconstruction.baselines:depth_anything_v2",
    "nafnet": "kornia_tidy.reconstruction:NAFNet",
    "phasecam3d": "kornia_tidy.reconstruction:PhaseCam3DUNet",
    "midas-small": "kornia_tidy.reconstruction:MiDaSSmall",
    "plain": "kornia_tidy.reconstruction.heads:PlainHead",
    "zoedepth": "kornia_tidy.reconstruction.baselines:zoedepth",
}
ANY_CAMERA = "any-camera"
CLOSED_FORMS = ("tikhonov", "tikhonov-bilateral", "wiener", "wiener-bilateral", ANY_CAMERA)
"""Heads that need a camera's PSFs and no training with it: closed forms, and the shipped network that corrects one."""
FIXED = ("midas-small",)  # three input channels, and one width
DEEPENED = ("nafnet",)  # take the number of their blocks, as repeats


def check_head(name: str) -> None:
    """Raise ``ValueError`` unless a head is known by name or is written as an import path, ``module:Class``.

    Example:
        >>> check_head("nafnett")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: head must be one of 'attention-unet', ..., or the path of a class such as \
my_package.networks:Network, got 'nafnett'
    """
    known = (*HEADS, *CLOSED_FORMS)
    module, colon, attribute = name.partition(":")
    is_path = bool(colon) and attribute.isidentifier() and all(part.isidentifier() for part in module.split("."))
    if name not in known and not is_path:
        raise ValueError(
            f"head must be one of {', '.join(map(repr, known))}, or the path of a class such as "
            f"my_package.networks:Network, got {name!r:.80}"
        )


def check_imported(name: str) -> None:
    """Raise ``ValueError`` for a head by import path from a module that is not imported yet.

    To import a module runs its code, and which one it is may not be for a file to say.

    Args:
        name: of a head, as a checkpoint tells it.

    Example:
        >>> check_imported("nafnet")
        >>> check_imported("antigravity:Network")
        Traceback (most recent call last):
        ...
        ValueError: the head 'antigravity:Network' is a class of a module that is not imported: if you trust the file, \
import antigravity before it is loaded
    """
    module, colon, _ = name.partition(":")
    if colon and module not in sys.modules:
        raise ValueError(
            f"the head {name!r:.80} is a class of a module that is not imported: if you trust the file, import "
            f"{module:.60} before it is loaded"
        )


def check_repeats(name: str, repeats: int) -> None:
    """Raise ``ValueError`` if a head has no blocks to repeat.

    Example:
        >>> check_repeats("nafnet", 2)
    """
    if repeats != 1 and name not in DEEPENED:
        raise ValueError(f"repeats are for the head {', '.join(DEEPENED)}, got {repeats} for {name!r:.80}")
