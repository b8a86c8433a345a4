"""Files of a reconstruction: pictures, depth maps with their uncertainty, and depth in colours."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from kornia_tidy.data.depth_files import write_depth
from kornia_tidy.data.image_files import write_image
from kornia_tidy.figures.depth import draw_depth
from kornia_tidy.figures.style import require_matplotlib, save_figure
from kornia_tidy.files import parse_json, remove_leftovers, write_bytes
from kornia_tidy.lab.capture_file import CaptureLight
from kornia_tidy.lab.file_jobs import Row, output_paths, work_on_all
from kornia_tidy.reconstruction.light_head import (
    LightHead,
    Reconstruction,
    UncertainReconstruction,
    reconstruct_light,
    with_noise_of,
)
from kornia_tidy.reconstruction.tasks import MAPS
from kornia_tidy.reconstruction.tiled import OVERLAP

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


def reconstruct_files(
    files: Sequence[str],
    folder: Path,
    head: LightHead,
    read: Callable[[str], CaptureLight],
    *,
    words: Mapping[str, Any] | None = None,
    inputs: Sequence[str] = (),
    resume: bool = False,
    picture: str = ".png",
    depth_unit: float = 1e-3,
    memory_budget: int = 512 << 20,
    overlap: int = OVERLAP,
) -> list[Row]:
    """Reconstruct captures of files into a folder, and go on after errors.

    Args:
        files: captures.
        folder: gets the files of :func:`reconstruction_suffixes` for each, and last a JSON file that describes them;
            made if missing.
        head: the network.
        read: from a file to its light, such as :func:`~kornia_tidy.lab.capture_file.read_light`.
        words: settings, for the JSON files.
        inputs: files that the results depend on beside the captures, such as a checkpoint.
        resume: keep results that are complete, of the same files and ``words``.
        picture: suffix of the picture of 16 bits.
        depth_unit: metres of a unit of depth in PNG files.
        memory_budget: bytes for the network's tiles.
        overlap: pixels of a tile that are discarded at each cut.

    Returns:
        For each file ``"done"``, ``"kept"``, or the sentence of its error, which is also printed.

    Raises:
        ValueError: if two files would get the same results, or one would be replaced.
    """
    suffixes = reconstruction_suffixes(head.task, picture, uncertain=head.uncertain)
    if "_depth_colors.png" in suffixes:
        require_matplotlib()
    outputs = output_paths(files, folder, [*suffixes, ".json"])
    folder.mkdir(parents=True, exist_ok=True)
    if resume:
        remove_leftovers(folder)

    def work(path: str, progress: Callable[[int, int], None]) -> Row:
        start, paths = time.perf_counter(), outputs[path]
        made_of = {"source": _identity(path), "inputs": [_identity(each) for each in inputs], **(words or {})}
        made_of = json.loads(json.dumps(made_of))
        if resume and _is_finished(paths, made_of):
            return Row(path, "kept")
        capture = read(path)
        options: dict[str, Any] = {"memory_budget": memory_budget, "overlap": overlap, "progress": progress}
        own = with_noise_of(head, capture.noise)
        result, capture = reconstruct_light(own, capture.light, **options), capture._replace(light=torch.empty(0))
        size = write_reconstruction(paths[:-1], result, capture, head, depth_unit)
        record = {**made_of, "size": size, **reconstruction_in_words(head, depth_unit)}
        record |= {"notes": list(result.notes)} if result.notes else {}
        record |= {"noise": capture.noise.extra_repr()} if capture.noise is not None else {}
        write_bytes(paths[-1], (json.dumps(record, indent=1) + "\n").encode())
        return Row(path, "done", f"{size[0]} x {size[1]}", time.perf_counter() - start, result.notes)

    return work_on_all("reconstruct", list(outputs), work)


def _is_finished(paths: Sequence[Path], made_of: Mapping[str, Any]) -> bool:
    """Return whether all results of a file exist, made of the same files with the same settings."""
    try:
        record = parse_json(paths[-1].read_bytes())
    except (OSError, ValueError):
        return False
    same = isinstance(record, dict) and all(record.get(name) == value for name, value in made_of.items())
    return same and all(path.is_file() for path in paths)


def _identity(path: str) -> dict[str, Any]:
    """Return the identity of an input file."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"cannot read {path}: there is no such file")
    state = Path(path).stat()
    return {"file": Path(path).name, "bytes": state.st_size, "modified": state.st_mtime_ns}
