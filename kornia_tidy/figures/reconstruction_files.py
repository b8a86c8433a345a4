"""Files of a reconstruction: pictures, depth maps with their uncertainty, and depth in colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kornia_tidy.data.depth_files import write_depth
from kornia_tidy.data.image_files import write_image
from kornia_tidy.figures.depth import draw_depth
from kornia_tidy.figures.style import save_figure
from kornia_tidy.lab.capture_file import CaptureLight
from kornia_tidy.reconstruction.light_head import LightHead, Reconstruction, UncertainReconstruction
from kornia_tidy.reconstruction.tasks import MAPS

SMALLEST_DEVIATION = 1e-9  # m


def reconstruction_suffixes(task: str, picture: str = ".png", *, uncertain: bool = False) -> list[str]:
    """Return the suffixes of the files of a reconstruction.

    Args:
        task: of the network.
        picture: suffix of the picture of 16 bits.
        uncertain: whether the network estimates the uncertainty of depth.

    Example:
        >>> reconstruction_suffixes("edof", ".tif")
        ['.tif', '.jpg']
    """
    image = [picture, ".jpg"] if "image" in MAPS[task] else []
    depth = ["_depth.png", "_depth.pfm", "_depth.npy", "_depth_colors.png"] if "depth" in MAPS[task] else []
    deviation = ["_deviation.png", "_deviation.pfm", "_deviation.npy"] if uncertain else []
    return [*image, *depth, *deviation]


def write_reconstruction(
    paths: Sequence[Path],
    result: Reconstruction | UncertainReconstruction,
    capture: CaptureLight,
    head: LightHead,
    depth_unit: float = 1e-3,
) -> tuple[int, int]:
    """Write the maps of a reconstruction, upright.

    Args:
        paths: files with the suffixes of :func:`reconstruction_suffixes`.
        result: the maps, as the pixels lie on the sensor.
        capture: that they were made of.
        head: that made them.
        depth_unit: metres of a unit of depth in PNG files; others hold metres.

    Returns:
        Columns and rows.
    """
    upright = capture.upright
    image = None if result.image is None else upright(result.image)
    depth = None if result.depth is None else upright(result.depth)
    deviation = unknown = None
    if isinstance(result, UncertainReconstruction):
        # A depth file holds no zero.
        deviation = upright(result.deviation).clamp(min=SMALLEST_DEVIATION)
        unknown = upright(result.relative_deviation)
    for path in paths:
        if path.name.endswith("_depth_colors.png"):
            assert depth is not None
            save_figure(path, draw_depth(depth, head.camera, unknown))
        elif path.stem.endswith("_depth") and depth is not None:
            write_depth(path, depth, depth_unit if path.suffix == ".png" else 1.0, saturate=True)
        elif path.stem.endswith("_deviation"):
            assert deviation is not None
            write_depth(path, deviation, depth_unit if path.suffix == ".png" else 1.0, saturate=True)
        else:
            assert image is not None
            write_image(path, image, 8 if path.suffix == ".jpg" else 16, capture.info)
    height, width = next(part for part in (image, depth) if part is not None).shape[-2:]
    return width, height


def reconstruction_in_words(head: LightHead, depth_unit: float = 1e-3) -> dict[str, str]:
    """Describe the values in the files of :func:`write_reconstruction`, by name."""
    unit, (near, far) = depth_unit, head.camera.depth_range
    words = {}
    if "image" in MAPS[head.task]:
        words["image"] = "all in focus, 16 bits, encoded as sRGB"
    if "depth" in MAPS[head.task]:
        words["depth_png"] = f"metres = value * {unit:g}; 65535 is {65535 * unit:g} m or farther"
        if head.uncertain:
            words["deviation_png"] = f"metres = value * {unit:g}; 65535 is {65535 * unit:g} m or more, or unbounded"
        words["depth_range"] = f"{near:g} to {far:g} m: the camera's; nearer and farther have its ends"
    return words
