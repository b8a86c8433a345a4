"""Legends under the pictures of the app, and its messages: one sentence for a mistake."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from kornia_tidy.cli.app.capture import Result
from kornia_tidy.cli.app.settings import FLAT, OWN
from kornia_tidy.reconstruction.pretrained import PRETRAINED

MANY_CLAMPED = 0.02  # share of the pixels beyond the camera's range; a camera fitted to a scene leaves 1 % there


def legends(result: Result) -> dict[str, str]:
    """Return the legend of each picture by name, in Markdown."""
    settings, scores = result.settings, result.scores()
    height, width = result.capture.shape[-2:]
    count = len(result.optics.masks.phase)
    plain = (settings.camera == OWN and settings.start == FLAT) or settings.camera.endswith(("-0", "-flat"))
    through = "a lens without programmed masks" if plain else f"{count} masks, in turn" if count > 1 else "1 mask"
    by = f"of {settings.camera}" if settings.camera in PRETRAINED else "for any camera, not trained for this one"
    window = result.optics.window
    return {
        "scene": f"**Scene**, all in focus, {width} x {height} pixels.",
        "capture": f"**Capture**: one exposure through {through}; {result.optics.compositing}, noise "
        f"{100 * settings.noise:.3g} % of full scale. PSNR {scores['capture_psnr']:.1f} dB against the scene.",
        "image": f"**Reconstruction** by the network {by}. PSNR {scores['image_psnr']:.1f} dB.",
        "depth": "**Depth of the scene**, metres; bright is near.",
        "estimate": _estimated(scores),
        "psfs": f"**Masks and PSFs over depth.** Left: phase of each mask at 530 nm, 0 to 2π, dark at 0 and 2π. Right: "
        f"a white point on the sensor, {window} x {window} pixels, root of the light, each on its own scale; ψ is the "
        f"defocus in radians." + (" The sensor adds up all masks, which gives the average." if count > 1 else ""),
    }


def _estimated(scores: dict[str, float]) -> str:
    if "depth_rmse" not in scores:
        return "**No depth estimate**: this camera has no network for depth. Trained systems *joint* have one."
    return (
        f"**Estimated depth** from only the capture. RMSE {scores['depth_rmse']:.2f} of the range in inverse depth; "
        f"one depth everywhere would have {scores['mean_rmse']:.2f}."
    )


def status(result: Result, seconds: float) -> str:
    """Return camera and time in one line, and a note if pixels lie beyond the camera's range."""
    camera = result.camera
    near, far = (f"{end:.3g} m" if math.isfinite(end) else "infinity" for end in camera.depth_range)
    lens = f"{result.optics.lens.name}, " if result.optics.lens is not None else ""
    line = (
        f"{lens}{camera.focal_length * 1e3:.4g} mm f/{camera.f_number:.3g}, focus at "
        f"{float(camera.focus_distance):.3g} m, pixels of {camera.pixel_pitch * 1e6:.3g} µm, "
        f"depths from {near} to {far}. Computed in {seconds:.1f} s."
    )
    if result.clamped <= MANY_CLAMPED:
        return line
    return (
        f"{line}\n\n**{100 * result.clamped:.0f} % of the pixels lie beyond these depths** and are blurred as at their "
        f"ends: stretch the depths, or choose another camera."
    )


def mistake(error: Exception, files: Sequence[str | None] = ()) -> str:
    r"""Return an error as one sentence, with the names of uploaded files and not their temporary folders.

    Example:
        >>> mistake(ValueError("cannot read /tmp/gradio/1/a.png:\n damaged"), ["/tmp/gradio/1/a.png"])
        'Cannot read a.png: damaged.'
    """
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "allocate memory" in str(error):
        return "There is not enough memory for these settings: make the picture smaller."
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    for path in files:
        if path:
            text = text.replace(path, Path(path).name)
    text = " ".join(text.replace(f"{tempfile.gettempdir()}/", "").split()) or type(error).__name__
    if not isinstance(error, (ImportError, KeyError, OSError, TypeError, ValueError)):
        text = f"this is a fault of kornia-tidy, not yours ({type(error).__name__}: {text}); please report it"
    return text[0].upper() + text[1:].rstrip(".") + "."
