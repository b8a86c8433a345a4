"""`kornia-tidy demo`: demonstration of capture and reconstruction, as two figures."""

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
from kornia_tidy.commands.options import add_depth_options, middle_depths, read_scene, seed
from kornia_tidy.commands.report import Stages, clamped_in_words, light_in_words, scene_in_words, tell
from kornia_tidy.data.dead_leaves import DeadLeaves
from kornia_tidy.data.image_files import write_image
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.figures.estimates import Estimate, draw_estimates
from kornia_tidy.figures.explained import explain
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.files import write_bytes
from kornia_tidy.inference.pretrained import load_pretrained
from kornia_tidy.inference.tasks import metres, normalised_inverse_depth, split_maps
from kornia_tidy.inference.trained import TrainedSystem
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.optics.thin_lens import ThinLensCamera

DESCRIPTION = """\
Photograph a scene with a camera with five phase masks, and reconstruct an all-in-focus image and the depth of every
pixel from this one capture with the network that was trained together with the masks. For comparison the same is done
with one mask, with a plain lens, and with five masks learnt for the image alone (EDoF). Without IMAGE and DEPTH the
scene is generated. The depths of IMAGE are stretched, in dioptres, over the range for which the masks were learnt.
"""

SYSTEMS = {"plain": "joint-0", "K = 1": "joint-1", "K = 5": "joint-5", "K=5 EDoF": "edof-5"}
LARGEST = 1024  # pixels of the longer side; larger pictures are made smaller, to keep a demonstration short
DOTS_PER_INCH = 150
CAPTION = (
    "The heights of these masks were learnt together with the network that reads the captures. Both captures are taken "
    "with them, the upper one with the first alone. Each PSF is drawn on its own scale, as the root of its light."
)


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "demo", help="from a scene to a coded capture and back, as two pictures", description=DESCRIPTION
    )
    parser.set_defaults(run=run)
    parser.add_argument("--image", metavar="IMAGE", help="picture of a scene (default: dead leaves, made here)")
    parser.add_argument("--depth", metavar="DEPTH", help="its depth")
    add_depth_options(parser)
    parser.add_argument(
        "-o", "--output", default="outputs", metavar="FOLDER", help="made if missing (default: outputs)"
    )
    parser.add_argument("--size", type=int, default=512, metavar="PX", help="side of the scene made (default: 512)")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of scene and noise (default: 0)")


def run(args: argparse.Namespace) -> None:
    """Simulate captures, reconstruct images and depth, and write the two figures."""
    if (args.image is None) != (args.depth is None):
        raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")
    require_matplotlib()
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    stages = Stages()
    progress = tqdm(
        total=len(SYSTEMS) + 3,
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
            systems = {name: load_pretrained(which) for name, which in SYSTEMS.items()}
            optics = systems["K = 5"].optics
            camera = optics.camera
            assert isinstance(camera, ThinLensCamera)  # as in the training of the systems
            scene = _scene(args, camera)
            near = normalised_inverse_depth(camera, scene.depth)
        estimates = {}
        for name, system in systems.items():
            with step(name):
                estimates[name] = _estimate(name, system, scene, args.seed)
        best = estimates["K = 5"]
        with step("first mask"):
            times = DwellTimes([1.0] + [0.0] * (len(optics.masks.phase) - 1))
            first = TiDyOptics(optics.masks, optics.camera, times, optics.sensor, optics.fidelity)
            alone = first(scene.image, scene.depth, generator=torch.Generator().manual_seed(args.seed))
        with step("pictures"):
            explained, reconstructed = BytesIO(), BytesIO()
            explain(scene.image, scene.depth, optics, alone, best.capture, CAPTION).savefig(
                explained, dpi=DOTS_PER_INCH
            )
            figure = draw_estimates(scene.image, near, list(estimates.values()), scene.valid)
            figure.savefig(reconstructed, dpi=DOTS_PER_INCH)
        bank = optics.psf_bank()

    assert best.inverse_depth is not None  # it is a joint system
    pictures = {
        "scene.png": scene.image,
        "depth.png": near,
        "coded_plain.png": estimates["plain"].capture,
        "coded_k1.png": estimates["K = 1"].capture,
        "coded_k5.png": best.capture,
        "estimated_scene.png": best.image,
        "estimated_depth.png": best.inverse_depth,
        "estimated_scene_alone.png": estimates["K=5 EDoF"].image,
    }
    files = {"demo.png": explained.getvalue(), "reconstruction.png": reconstructed.getvalue()}
    with stages("write"):
        _write(folder, pictures, files)

    tell("scene", scene_in_words(scene))
    tell("camera", camera.extra_repr())
    tell("masks", f"{optics.masks.extra_repr()}, learnt in {systems['K = 5'].step} steps on dead leaves")
    tell("PSFs", light_in_words(bank, optics))
    tell("clamped", clamped_in_words(optics, scene.depth))
    _tell_scores(estimates, scene, near)
    tell("wrote", f"{folder / 'demo.png'}: how the capture comes about")
    tell("", f"{folder / 'reconstruction.png'}: what is made of it")
    for name in pictures:
        tell("", str(folder / name))
    tell("time", stages.summary())


def _tell_scores(estimates: Mapping[str, Estimate], scene: Scene, near: Tensor) -> None:
    for name, estimate in estimates.items():
        scores = estimate.scores(scene.image, near, scene.valid)
        depth = f"; depth RMSE {scores['depth_rmse']:.3f} of the range" if estimate.inverse_depth is not None else ""
        tell(
            name,
            f"capture {scores['capture_psnr']:.2f} dB; all in focus {scores['image_psnr']:.2f} dB, "
            f"SSIM {scores['image_ssim']:.3f}{depth}",
        )


def _write(folder: Path, pictures: Mapping[str, Tensor], files: Mapping[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in pictures.items():
        write_image(folder / name, image.clamp(0, 1))
    for name, content in files.items():
        write_bytes(folder / name, content)


def _estimate(name: str, system: TrainedSystem, scene: Scene, noise: int) -> Estimate:
    """Photograph a scene and reconstruct it."""
    capture = system.optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(noise))
    maps = split_maps(system.settings.task, system.head(capture[None]))
    return Estimate(name, capture, maps["image"][0], maps["depth"][0] if "depth" in maps else None)


def _scene(args: argparse.Namespace, camera: ThinLensCamera) -> Scene:
    """Return a colour scene with depths stretched over the camera's range."""
    if args.image is None:
        return DeadLeaves(1, args.size, args.size, depth_range=camera.depth_range, seed=args.seed).read(0)
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
