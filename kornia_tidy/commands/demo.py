"""`kornia-tidy demo`: demonstration of capture and reconstruction beside a stopped-down lens, as two pages."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.transform import resize
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_positive
from kornia_tidy.commands.demo_cameras import (
    REFERENCE_F_NUMBER,
    Camera,
    Result,
    photograph,
    shipped_cameras,
    stopped_down,
)
from kornia_tidy.commands.options import add_depth_options, middle_depths, read_scene, seed
from kornia_tidy.commands.report import Stages, clamped_in_words, scene_in_words, tell
from kornia_tidy.data.image_files import write_image
from kornia_tidy.data.photographic_leaves import PhotographicLeaves
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.figures.comparison import Panel, draw_comparison
from kornia_tidy.figures.depth import depth_colors
from kornia_tidy.figures.explained import explain
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.files import write_bytes
from kornia_tidy.inference.tasks import metres, normalised_inverse_depth
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.metrics import psnr, rmse, ssim
from kornia_tidy.sensor.exposure import electrons_at

DESCRIPTION = """\
Photograph a scene with phase masks in a wide aperture, and with a lens without masks that is stopped down: the same
exposure time and the same light. Both captures are restored in closed form and, where a trained network is shipped for
the camera, by the network. A third camera estimates the depth of every pixel. All scores are on the page. Without IMAGE
and DEPTH the scene is painted. The depths of IMAGE are stretched, in dioptres, over the range for which the masks were
made.
"""

EPILOG = """\
examples:
  kornia-tidy demo
  kornia-tidy demo --electrons 500                                      dim light
  kornia-tidy demo --image photo.png --depth depth.png --depth-scale 0.001
"""

ELECTRONS = 57_000.0
SEED = 5  # of a scene of many kinds of texture
LARGEST = 1024  # pixels of the longer side; larger pictures are made smaller, to keep a demonstration short
DOTS_PER_INCH = 150
TITLE = "Phase masks in a wide aperture, or a lens that is stopped down"
CAPTION = (
    "The shutter stays open while the masks follow one another. The upper capture is taken with the first mask alone. "
    "Each PSF is drawn on its own scale, as the root of its light."
)


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "demo",
        help="from a scene to captures and back, with and without masks, as two pages",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--image", metavar="IMAGE", help="picture of a scene (default: one that is painted here)")
    parser.add_argument("--depth", metavar="DEPTH", help="its depth")
    add_depth_options(parser)
    parser.add_argument(
        "-o", "--output", default="outputs", metavar="FOLDER", help="made if missing (default: outputs)"
    )
    parser.add_argument(
        "--electrons",
        type=float,
        default=ELECTRONS,
        metavar="N",
        help=f"of a white pixel at f/{REFERENCE_F_NUMBER:g}; less is dimmer light (default: {ELECTRONS:g})",
    )
    parser.add_argument("--size", type=int, default=512, metavar="PX", help="side of the scene made (default: 512)")
    parser.add_argument("--seed", type=seed, default=SEED, metavar="N", help=f"of scene and noise (default: {SEED})")


def run(args: argparse.Namespace) -> None:
    """Simulate captures, restore them, and write the two pages."""
    if (args.image is None) != (args.depth is None):
        raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")
    check_positive("electrons", args.electrons)
    require_matplotlib()
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    stages = Stages()
    progress = tqdm(
        total=6,
        desc="demo",
        bar_format="{desc}: {bar} {n}/{total} {postfix}",
        file=sys.stderr,
        leave=False,
        disable=None,
    )

    def step(name: str) -> Any:
        progress.update(int(bool(stages.seconds)))
        progress.set_postfix_str(name)
        return stages(name)

    with torch.no_grad(), progress:
        with step("scene"):
            cameras = shipped_cameras(args.electrons)
            lens = cameras["coded"].optics.camera
            assert isinstance(lens, ThinLensCamera)  # as in the training of the systems
            scene = _scene(args, lens)
            near = normalised_inverse_depth(lens, scene.depth)
        with step("search"):
            if "flat" not in cameras:
                cameras["flat"] = stopped_down(lens, args.electrons)
        results: dict[str, Result] = {}
        for name in ("coded", "flat", "joint"):
            if name in cameras:
                with step(name):
                    results[name] = photograph(cameras[name], scene, args.seed)
        with step("pages"):
            pages = {
                "demo.png": _explained(cameras["coded"], scene, results["coded"], args.seed),
                "reconstruction.png": _page(cameras, results, scene, near, args.electrons),
            }
    with stages("write"):
        pictures = _pictures(results, scene, near)
        _write(folder, pictures, pages)

    tell("scene", scene_in_words(scene))
    tell("light", _light(cameras, args.electrons))
    tell("clamped", clamped_in_words(cameras["coded"].optics, scene.depth))
    for name, result in results.items():
        tell(name, _scores_in_words(cameras[name], result, scene, near))
    tell("verdict", _verdict(results, scene))
    tell("wrote", f"{folder / 'reconstruction.png'}: read this one first")
    tell("", f"{folder / 'demo.png'}: how the masks make a capture")
    for name in pictures:
        tell("", str(folder / name))
    tell("time", stages.summary())


def _explained(camera: Camera, scene: Scene, result: Result, noise: int) -> bytes:
    """Return the picture that explains how a capture is made, as PNG."""
    optics = camera.optics
    small = TiDyOptics(optics.masks, optics.camera, optics.modulator, optics.sensor)  # its PSFs fill their pictures
    times = DwellTimes([1.0] + [0.0] * (len(optics.masks.phase) - 1))
    first = TiDyOptics(
        optics.masks, optics.camera, times, optics.sensor, optics.fidelity, color_space=optics.color_space,
        border=optics.border,
    )  # fmt: skip
    alone = first(scene.image, scene.depth, generator=torch.Generator().manual_seed(noise))
    page = BytesIO()
    explain(scene.image, scene.depth, small, alone, result.capture, CAPTION).savefig(page, dpi=DOTS_PER_INCH)
    return page.getvalue()


def _page(
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
        f"PSNR in dB and SSIM (at most 1) compare with the scene: more is better. {_light(cameras, electrons)}.",
        "Closed form: the linear filter with the least expected error by the statistics of photographs (Wiener), then "
        "a filter that smooths noise and keeps edges (bilateral).",
        "A network was trained for its camera. White square: the detail in the corner, three times as large. "
        f"Masks against no masks: {_verdict(results, scene)}.",
    ]
    page = BytesIO()
    subtitle = "One scene, the same exposure time, the same light: from the capture to an image in focus everywhere"
    draw_comparison(rows, TITLE, subtitle, notes).savefig(page, dpi=DOTS_PER_INCH)
    return page.getvalue()


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


def _name(camera: Camera) -> str:
    count = len(camera.optics.masks.phase)
    flat = camera.settings is None or camera.settings.start == "flat"
    words = "No masks" if flat else f"{count} mask{'s' if count > 1 else ''}"
    return f"{words}, f/{camera.f_number:.3g}"


def _score(image: Tensor, scene: Scene) -> str:
    pair = image[None].clamp(0, 1), scene.image[None]
    return f"{float(psnr(*pair)):.1f} dB, SSIM {float(ssim(*pair)):.2f}"


def _scores_in_words(camera: Camera, result: Result, scene: Scene, near: Tensor) -> str:
    parts = [f"capture {_score(result.capture, scene)}", f"closed form {_score(result.closed_form, scene)}"]
    if result.image is not None:
        parts.append(f"network {_score(result.image, scene)}")
    if result.inverse_depth is not None:
        error = rmse(result.inverse_depth[None].clamp(0, 1), near[None], scene.valid[None])
        parts.append(f"depth RMSE {float(error):.3f} of the range")
    return f"{_name(camera)}: {'; '.join(parts)}"


def _light(cameras: Mapping[str, Camera], electrons: float) -> str:
    """Return the light of the two cameras in words."""
    counts = [
        f"{float(f'{electrons_at(cameras[name].f_number, electrons, REFERENCE_F_NUMBER):.2g}'):,.0f} electrons at "
        f"f/{cameras[name].f_number:.3g}"
        for name in ("coded", "flat")
    ]
    return f"In the same time a white pixel collects {' and '.join(counts)}"


def _verdict(results: Mapping[str, Result], scene: Scene) -> str:
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


def _pictures(results: Mapping[str, Result], scene: Scene, near: Tensor) -> dict[str, Tensor]:
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


def _write(folder: Path, pictures: Mapping[str, Tensor], pages: Mapping[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in pictures.items():
        write_image(folder / name, image.clamp(0, 1))
    for name, content in pages.items():
        write_bytes(folder / name, content)


def _scene(args: argparse.Namespace, camera: ThinLensCamera) -> Scene:
    """Return a colour scene with depths stretched over the camera's range."""
    if args.image is None:
        return PhotographicLeaves(1, args.size, args.size, depth_range=camera.depth_range, seed=args.seed).read(0)
    image, depth, valid = read_scene(args)
    if max(image.shape[-2:]) > LARGEST:
        image = resize(image[None], LARGEST, side="long", antialias=True)[0].clamp(0, 1)
        depth, valid = (
            resize(plane[None].float(), LARGEST, side="long", interpolation="nearest")[0] for plane in (depth, valid)
        )
    valid = valid > 0
    return Scene(image.expand(3, -1, -1), stretched(depth, valid, camera), valid)


def stretched(depth: Tensor, valid: Tensor, camera: ThinLensCamera) -> Tensor:
    """Stretch the depths of a scene, linearly in dioptres, over a camera's range.

    Example:
        >>> depth = torch.tensor([[[2.0, 3.0, 6.0]]])
        >>> stretched(depth, depth > 0, ThinLensCamera()).round(decimals=4)
        tensor([[[0.2975, 0.5950,    inf]]])
    """
    near, far = (1 / end for end in middle_depths(depth, valid))
    return metres(camera, ((1 / depth - far) / (near - far)))
