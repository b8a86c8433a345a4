"""Report lines of commands: scene, PSFs and clamping in words."""

from __future__ import annotations

import sys
from typing import Any

from torch import Tensor
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.psf.psf_bank import PSFBank


def progress_bar(what: str, **options: Any) -> tqdm:
    """Return a bar of progress on standard error, which vanishes at the end; none where that is not a terminal.

    Example:
        >>> bar = progress_bar("render", total=2)
        >>> bar.disable, bar.leave  # an example has no terminal
        (True, False)
    """
    return tqdm(desc=what, file=sys.stderr, leave=False, **{"disable": None, **options})


def tell(topic: str, text: str) -> None:
    """Print one line of a report with its topic in the margin."""
    print(f"{topic:<9} {text}", flush=True)


def tell_camera(optics: TiDyOptics, masks: str | None = None) -> None:
    """Print the lines of a camera, its real lens and its masks, which may be described in words."""
    tell("camera", optics.camera.extra_repr())
    if optics.lens is not None:
        tell("lens", optics.lens.extra_repr())
    tell("masks", masks or optics.masks.extra_repr())


def scene_in_words(scene: Scene) -> str:
    """Return size and depths of a scene."""
    height, width = scene.image.shape[-2:]
    colour = "RGB" if scene.image.shape[0] == 3 else "grey"
    holes = 1 - float(scene.valid.float().mean())
    filled = f", {100 * holes:.1f} % of it unknown and taken from the nearest known pixel" if holes else ""
    near, far = scene.depth.aminmax()
    return f"{width} x {height} px {colour}, depth {float(near):.4g} to {float(far):.4g} m{filled}"


def light_in_words(bank: PSFBank, optics: TiDyOptics) -> str:
    """Describe the PSF window and its ensquared energy over all depths."""
    fate = {
        "renormalize": "the rest is given back to the window",
        "veil": "the rest is spread over the image",
        "discard": "the rest is lost",
    }[optics.fidelity.stray_light]
    names = ("red", "green", "blue") if bank.energy.shape[1] == 3 else ("530 nm",)
    shares = [
        f"{name} {100 * float(lo):.0f}-{100 * float(hi):.0f} %"
        for name, lo, hi in zip(names, bank.energy.amin(0), bank.energy.amax(0), strict=True)
    ]
    return (
        f"{len(bank.defocus)} depths, window {bank.window} x {bank.window} px holds {', '.join(shares)} of a point's "
        f"light; {fate}"
    )


def clamped_in_words(optics: TiDyOptics, depth: Tensor) -> str:
    """Describe how many pixels of the last capture lay beyond the camera's range."""
    count = optics.clamped_pixels
    if not count:
        return "no pixel lies beyond the camera's range"
    return f"{count} of {depth.numel()} pixels ({100 * count / depth.numel():.3g} %) lie beyond the camera's range"
