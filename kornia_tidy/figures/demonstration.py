"""Pages of the demonstration: how masks make a capture, and captures and restorations with and without masks."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.design.compared_cameras import REFERENCE_F_NUMBER, Camera, Result
from kornia_tidy.figures.comparison import Panel, draw_comparison
from kornia_tidy.figures.depth import depth_colors
from kornia_tidy.figures.explained import explain
from kornia_tidy.figures.style import encoded_figure
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.reconstruction.head_names import ANY_CAMERA
from kornia_tidy.reconstruction.metrics import psnr, rmse, ssim
from kornia_tidy.sensor.exposure import electrons_at

DOTS_PER_INCH = 150
TITLE = "Phase masks in a wide aperture, or a lens that is stopped down"
CAPTION = (
    "The upper capture is taken with only the first mask. Each PSF is drawn on its own scale, as the root of its light."
)


def explained_page(camera: Camera, scene: Scene, result: Result, noise: int) -> bytes:
    """Return the picture that explains how a capture is made, as PNG."""
    optics = camera.optics
    small = TiDyOptics(optics.masks, optics.camera, optics.modulator, optics.sensor)  # its PSFs fill their pictures
    times = DwellTimes([1.0] + [0.0] * (len(optics.masks.phase) - 1))
    first = TiDyOptics(
        optics.masks, optics.camera, times, optics.sensor, optics.fidelity, color_space=optics.color_space,
        border=optics.border,
    )  # fmt: skip
    alone = first(scene.image, scene.depth, generator=torch.Generator().manual_seed(noise))
    return encoded_figure(explain(scene.image, scene.depth, small, alone, result.capture, CAPTION), DOTS_PER_INCH)


def comparison_page(
    cameras: Mapping[str, Camera], results: Mapping[str, Result], scene: Scene, near: Tensor, electrons: float
) -> bytes:
    """Return the page of comparison, as PNG."""
    rows: list[list[Panel | None]] = [
        [Panel("The scene", scene.image, "in focus everywhere"), *_panels("Masks", cameras, results, scene)],
        [
            Panel("Its depth", depth_colors(near), "bright is near", zoomed=False),
            *_panels("No masks", cameras, results, scene),
        ],
    ]
    if "joint" in results:
        rows.append([None, *_joint_panels(cameras["joint"], results["joint"], scene, near)])
    notes = [
        "PSNR in dB and SSIM (at most 1) compare with the scene: more is better. "
        f"{light_in_words(cameras, electrons)}.",
        "Closed form: the linear filter with the least expected error by the statistics of photographs (Wiener), then "
        "a filter that smooths noise and keeps edges (bilateral).",
        f"{_training_in_words(cameras['coded'])} White square: the detail in the corner, three times as large.",
        f"Masks against no masks: {verdict_in_words(results, scene)}.",
    ]
    subtitle = "One scene, the same exposure time, the same light: from the capture to an image in focus everywhere"
    return encoded_figure(draw_comparison(rows, TITLE, subtitle, notes), DOTS_PER_INCH)


def _panels(
    kind: str, cameras: Mapping[str, Camera], results: Mapping[str, Result], scene: Scene
) -> list[Panel | None]:
    """Return capture, closed form and network of the camera with masks or of that without."""
    name = "coded" if kind == "Masks" else "flat"
    camera, result = cameras[name], results[name]
    panels: list[Panel | None] = [
        Panel(f"{_name(camera)}: capture", result.capture, _score(result.capture, scene)),
        Panel("restored in closed form", result.closed_form, _score(result.closed_form, scene)),
    ]
    if result.image is not None:
        panels.append(Panel("restored by the network", result.image, _score(result.image, scene)))
    return panels


def _joint_panels(camera: Camera, result: Result, scene: Scene, near: Tensor) -> list[Panel]:
    """Return capture, image and depth of the camera that estimates depth."""
    assert result.image is not None
    assert result.inverse_depth is not None
    error = float(rmse(result.inverse_depth[None].clamp(0, 1), near[None], scene.valid[None]))
    return [
        Panel(f"{_name(camera)} for depth: capture", result.capture, _score(result.capture, scene)),
        Panel("its image by the network", result.image, _score(result.image, scene)),
        Panel(
            "its depth by the network",
            depth_colors(result.inverse_depth),
            f"error {error:.3f} of the range of 1/depth (RMSE)",
            zoomed=False,
        ),
    ]


def _training_in_words(camera: Camera) -> str:
    """Return what the networks of a page were trained for, whose camera with masks is given."""
    if camera.settings is not None and camera.settings.head == ANY_CAMERA:
        return "The upper network restores any camera, each other one was trained for its camera."
    return "A network was trained for its camera."


def _name(camera: Camera) -> str:
    count = len(camera.optics.masks.phase)
    flat = camera.settings is None or camera.settings.start == "flat"
    words = "No masks" if flat else f"{count} mask{'s' if count > 1 else ''}"
    return f"{words}, f/{camera.f_number:.3g}"


def _score(image: Tensor, scene: Scene) -> str:
    pair = image[None].clamp(0, 1), scene.image[None]
    return f"{float(psnr(*pair)):.1f} dB, SSIM {float(ssim(*pair)):.2f}"


def scores_in_words(camera: Camera, result: Result, scene: Scene, near: Tensor) -> str:
    """Return the scores of capture and restorations in words."""
    parts = [f"capture {_score(result.capture, scene)}", f"closed form {_score(result.closed_form, scene)}"]
    if result.image is not None:
        parts.append(f"network {_score(result.image, scene)}")
    if result.inverse_depth is not None:
        error = rmse(result.inverse_depth[None].clamp(0, 1), near[None], scene.valid[None])
        parts.append(f"depth RMSE {float(error):.3f} of the range")
    return f"{_name(camera)}: {'; '.join(parts)}"


def light_in_words(cameras: Mapping[str, Camera], electrons: float) -> str:
    """Return the light of the two cameras in words."""
    counts = [
        f"{float(f'{electrons_at(cameras[name].f_number, electrons, REFERENCE_F_NUMBER):.2g}'):,.0f} electrons at "
        f"f/{cameras[name].f_number:.3g}"
        for name in ("coded", "flat")
    ]
    return f"In the same time a white pixel collects {' and '.join(counts)}"


def verdict_in_words(results: Mapping[str, Result], scene: Scene) -> str:
    """Return the difference of the best restorations with and without masks in words."""
    best = {}
    for name in ("coded", "flat"):
        images = {"the closed form": results[name].closed_form}
        if (image := results[name].image) is not None:
            images["the network"] = image
        scores = {how: float(psnr(one[None].clamp(0, 1), scene.image[None])) for how, one in images.items()}
        how = max(scores, key=lambda how: scores[how])
        best[name] = how, scores[how]
    gain = best["coded"][1] - best["flat"][1]
    return f"{gain:+.1f} dB on this scene, by {best['coded'][0]} with masks and by {best['flat'][0]} without"


def pictures_of(results: Mapping[str, Result], scene: Scene, near: Tensor) -> dict[str, Tensor]:
    """Return the single pictures by file name."""
    pictures = {"scene.png": scene.image, "depth.png": near}
    for name, result in results.items():
        pictures[f"{name}_capture.png"] = result.capture
        pictures[f"{name}_closed_form.png"] = result.closed_form
        if result.image is not None:
            pictures[f"{name}_network.png"] = result.image
        if result.inverse_depth is not None:
            pictures[f"{name}_depth.png"] = result.inverse_depth
    return pictures
