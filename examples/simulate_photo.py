"""Simulate one photo: your own image and depth, or a scene that the library makes up.

python examples/simulate_photo.py
python examples/simulate_photo.py --image photo.png --depth depth.png --depth-scale 0.001
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from kornia_tidy import ThinLensCamera, TiDyOptics
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.image_files import write_image
from kornia_tidy.data.rgbd import read_rgbd


def main(arguments: Sequence[str] | None = None) -> Path:
    """Take the picture and return where it was written."""
    options = parse(arguments)
    if options.image is None:
        image, depth = dead_leaves(options.size, options.size, depth_range=(0.3, 10.0), seed=options.seed)
    else:
        image, depth, _ = read_rgbd(options.image, options.depth, scale=options.depth_scale)

    torch.manual_seed(options.seed)
    optics = TiDyOptics(camera=camera_for(depth))
    coded = optics(image, depth)

    options.output.mkdir(parents=True, exist_ok=True)
    write_image(options.output / "scene.png", image)
    write_image(options.output / "coded.png", coded)
    print(optics)
    print(f"{image.shape[-2]}x{image.shape[-1]} pixels, depth {depth.min():.3g} to {depth.max():.3g} m")
    print(f"wrote {options.output / 'scene.png'} and {options.output / 'coded.png'}")
    return options.output / "coded.png"


def camera_for(depth: torch.Tensor) -> ThinLensCamera:
    """Return the default camera where it serves, or one that spreads its range of defocus over the scene's depths."""
    camera = ThinLensCamera()
    near, far = float(depth.min()), float(depth.max())
    return camera if near >= camera.depth_range[0] else ThinLensCamera.for_scene((near, max(far, 2 * near)))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", type=Path, help="sRGB picture (default: a scene of dead leaves)")
    parser.add_argument("--depth", type=Path, help="its depth map, of the same size")
    parser.add_argument("--depth-scale", type=float, default=1.0, help="metres per stored unit (default: 1)")
    parser.add_argument("--size", type=int, default=384, help="side of the made-up scene in pixels (default: 384)")
    parser.add_argument("--seed", type=int, default=0, help="of scene, masks and noise (default: 0)")
    parser.add_argument("--output", type=Path, default=Path("outputs/simulate_photo"), help="folder to write to")
    options = parser.parse_args(arguments)
    if (options.image is None) != (options.depth is None):
        parser.error("--image and --depth go together")
    return options


if __name__ == "__main__":
    main()
