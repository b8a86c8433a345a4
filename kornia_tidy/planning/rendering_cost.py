"""The cost of rendering a scene, before it is rendered: the work of each backend, time and memory of the fastest.

The backends count as they do for :mod:`kornia_tidy.render.dispatch`, from the labels of the pixels alone. Time is
priced by :mod:`kornia_tidy.render.cost_model`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.render.backends import direct, direct_occlusion, overlap
from kornia_tidy.render.backends.tile_plan import BLOCKS, OVERLAPS, WINDOWS, cheapest_grid
from kornia_tidy.render.cost_model import (
    DenseOcclusionWork,
    DenseWork,
    DirectOcclusionWork,
    DirectWork,
    OverlapWork,
    TiledOcclusionWork,
    Work,
    seconds_of,
)
from kornia_tidy.render.cost_profile import EPYC, CostProfile
from kornia_tidy.render.dispatch import LARGEST_PLANE
from kornia_tidy.render.layers import assign_layers
from kornia_tidy.render.scene import SAMPLE, Labels

OCCLUSION_PLANES = 6  # of a chunk at a time: light, spectra, products and quotients; 0.99 to 1.46 of the measured peak
DENSE_PLANES = 7  # at a time: three spectra, the blurred layer, the pixels picked so far, twice, and a copy
OVERLAP_PLANES = 7  # of a thread: light, labels, weights and sums of a window, two spectra, and one on its way back


@dataclass(frozen=True)
class SceneWork:
    """The work of each backend for a scene, in float32 and for one channel.

    Args:
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        works: work of the backends that support the scene, by name.
        layers: layers present in the scene.
        pixels: that have a layer, over the batch.
        image_pixels: of the output of one image.
    """

    compositing: str
    works: dict[str, Work]
    layers: int
    pixels: int
    image_pixels: int

    @property
    def profile(self) -> CostProfile:
        """The prices that the dispatcher takes for it."""
        return EPYC


def label_pixels(defocus: Tensor, batch: int, nodes: Sequence[float], mode: str) -> Labels:
    """Return the layers of each pixel, as the renderer finds them.

    Args:
        defocus: (B or 1, 1, H, W) radians.
        batch: images B.
        nodes: defocus of the layers that are rendered.
        mode: ``"nearest"`` or ``"linear"``.
    """
    lower, fraction = assign_layers(defocus, torch.tensor(nodes, dtype=defocus.dtype, device=defocus.device), mode)
    lower, fraction = (x[:, 0].expand(batch, -1, -1) for x in (lower, fraction))
    return Labels.of(lower, None if mode == "nearest" else fraction)


def count_work(labels: Labels, layers: int, window: int, compositing: str = "gather") -> SceneWork:
    """Count the work of each backend for a scene. Tiles and layers are counted on every eighth row and column.

    Args:
        labels: from :func:`label_pixels`; of the output's pixels for gather, else of the padded image's.
        layers: how many there are.
        window: side of the PSFs.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.

    Example:
        >>> flat = label_pixels(torch.zeros(1, 1, 64, 64), 1, (-1.0, 0.0, 1.0), "linear")
        >>> count_work(flat, 3, 9).layers
        1
    """
    batch, height, width = labels.layer_index.shape
    sample = torch.cat([layer.flatten() for layer in labels.every(SAMPLE).terms()])
    present, pixels = len(sample.unique()), labels.layer_index.numel()
    blended, extra = 1 if labels.layer_weight is None else 2, window - 1
    occlusion = compositing == "occlusion"
    works: dict[str, Work] = {"tiled": cheapest_grid(labels, layers, window, WINDOWS if occlusion else BLOCKS)[0]}
    if not occlusion and overlap.refusal(labels.layer_index.device, torch.float32) is None:
        works["overlap"] = cheapest_grid(labels, layers, window, OVERLAPS)[0]
    if compositing == "gather":
        works["dense"] = DenseWork(height + extra, width + extra, present, pixels, blended, batch)
        if direct.can_go_directly(labels, torch.float32):
            works["direct"] = DirectWork(pixels, direct.count_pairs(labels, torch.float32), window)
        return SceneWork(compositing, works, present, pixels, height * width)
    output = (height - extra) * (width - extra)
    if not occlusion:
        works["dense"] = DenseWork(height, width, present, batch * output, blended, batch)
        return SceneWork(compositing, works, present, pixels, output)
    works["dense"] = DenseOcclusionWork(height, width, present, batch * output, batch)
    scene = torch.empty(labels.layer_index[:, None].shape), torch.zeros(layers, 1, window, window)
    if labels.layer_index.device.type == "cpu" and direct_occlusion.can_go_directly(*scene):
        counts = direct_occlusion.count(*scene, labels.layer_index, labels.layer_weight)
        side = max(window, direct_occlusion.SMALLEST_SIDE)
        works["direct"] = DirectOcclusionWork(batch * output, *counts, side, layers)
    return SceneWork(compositing, works, present, pixels, output)


def rendering_seconds(scene: SceneWork, channels: int, *, double: bool = False, threads: int | None = None) -> float:
    """Return the time that rendering takes by the fastest backend.

    Args:
        scene: from :func:`count_work`.
        channels: of the image.
        double: in float64.
        threads: that share the work. Default: as many as torch has.

    Example:
        >>> flat = label_pixels(torch.zeros(1, 1, 64, 64), 1, (-1.0, 0.0, 1.0), "linear")
        >>> 0 < rendering_seconds(count_work(flat, 3, 9), channels=3) < 1
        True
    """
    return _fastest(scene, channels, double, threads)[0]


def rendering_bytes(scene: SceneWork, channels: int, *, double: bool = False, threads: int | None = None) -> int:
    """Return the peak memory that rendering takes without gradients, by the fastest backend.

    Directly that is a padded image, labels and what is returned. Overlapping windows add the spectra of the PSFs in one
    channel and the window that a thread works on, tiles all spectra and the planes of a chunk, dense rendering some
    planes of the whole.

    Args:
        scene: from :func:`count_work`.
        channels: of the image.
        double: in float64.
        threads: as for :func:`rendering_seconds`.
    """
    _, name, work = _fastest(scene, channels, double, threads)
    real, occlusion = 8 if double else 4, scene.compositing == "occlusion"
    labels = scene.pixels * (4 if occlusion else 2) * 8
    image = scene.pixels * channels * real
    if name == "direct":
        return 2 * image + labels
    if isinstance(work, (DenseWork, DenseOcclusionWork)):
        samples = work.batch * work.height * work.width * channels
        return DENSE_PLANES * samples * (2 * 8 if occlusion else real) + 2 * image + labels
    if isinstance(work, TiledOcclusionWork):
        plane = 16 * channels * work.size**2
        most = max(layers for layers, count in enumerate(work.windows) if count)
        chunk = OCCLUSION_PLANES * max(WINDOWS.chunk_bytes, 2 * plane * most)
        return 2 * scene.layers * plane + chunk + 2 * image + labels
    if isinstance(work, OverlapWork):  # spectra of one channel, and the windows that each thread works on
        planes = scene.layers + OVERLAP_PLANES * (threads or torch.get_num_threads())
        return planes * real * work.size**2 + 3 * image + labels
    plane = 2 * real * work.size**2
    chunk = 3 * max(BLOCKS.chunk_bytes, plane * math.ceil(work.pairs / work.blocks))
    return 2 * scene.layers * channels * plane + chunk + 4 * image + labels


def _fastest(scene: SceneWork, channels: int, double: bool, threads: int | None) -> tuple[float, str, Any]:
    """Return the time of the fastest backend, its name and its work."""
    profile, threads = scene.profile, threads or torch.get_num_threads()
    plane = scene.pixels * channels * (8 if double or scene.compositing == "occlusion" else 4)
    works = [
        (name, _as_rendered(work, channels, double))
        for name, work in scene.works.items()
        if name != "dense" or plane <= LARGEST_PLANE
    ]
    times = [(seconds_of(work, profile, threads), name, work) for name, work in works]
    return min(times, key=lambda entry: entry[0])


def _as_rendered(work: Any, channels: int, double: bool) -> Any:
    """Return the work for an image of some channels. In float64, vectors hold half as many pixels."""
    if isinstance(work, (TiledOcclusionWork, DenseOcclusionWork)):  # in float64 anyway
        return replace(work, channels=channels)
    if not double:
        return replace(work, channels=channels)
    if isinstance(work, DirectWork):
        return replace(work, channels=channels, itemsize=8, strips=2 * work.strips)
    if isinstance(work, DirectOcclusionWork):
        twice = {name: 2 * getattr(work, name) for name in ("alone", "pairs", "columns", "edges")}
        return replace(work, channels=channels, itemsize=8, **twice)
    return replace(work, channels=channels, itemsize=8)
