"""What rendering costs on a graphics processor: estimates from its arithmetic and bandwidth, measured by nobody.

A direct convolution is bound by the cache that each processor of the GPU reads its light and PSFs from; transforms of
all layers are bound by memory. Both estimates are times at the full rate of the data sheet, which no kernel reaches, so
they are for comparison alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from kornia_tidy.render.borders import padded_size
from kornia_tidy.render.scene import LayeredScene

GAIN = 4.0  # by which direct convolution must be estimated to be faster before "auto" may take it
INDEX_BYTES = 4  # of a pixel's layer
# Times that a sample of the planes of all layers goes to memory or comes from it: product, two passes of the inverse
# transform with a reading and a writing each, and two readings by the pixels of the image.
PASSES = 7
LAUNCHES = {"triton": 6, "batched": 12}  # of a forward pass with gather


@dataclass(frozen=True)
class GpuProfile:
    """The rates of a graphics processor.

    Args:
        name: of the GPU.
        flops: operations in float32 a second; a fused product and sum counts as two.
        cache_bytes: read from the first-level caches in a second.
        memory_bytes: read from memory or written to it in a second.
        launch: seconds that a kernel takes at least.
    """

    name: str
    flops: float
    cache_bytes: float
    memory_bytes: float
    launch: float


# From the data sheet, not measured: 132 processors at 1.98 GHz, each with 128 fused operations and 128 bytes a cycle;
# 3.35 TB/s of HBM3. A launch is taken as 5 microseconds.
H100 = GpuProfile("H100 SXM", 132 * 256 * 1.98e9, 132 * 128 * 1.98e9, 3.35e12, 5e-6)


def triton_seconds(scene: LayeredScene, profile: GpuProfile = H100) -> float:
    """Return the least time of direct convolution, see :mod:`kornia_tidy.render.backends.triton_direct`.

    Args:
        scene: to be rendered. None of its values is looked at: with occlusion every window may hold every layer.
        profile: of the GPU.

    Example:
        >>> import torch
        >>> from kornia_tidy.render.scene import layered_scene
        >>> image, psi, nodes = torch.rand(8, 3, 278, 278), torch.zeros(8, 1, 278, 278), torch.arange(21.0)
        >>> scene = layered_scene(image, psi, nodes, torch.rand(21, 3, 23, 23))
        >>> f"{1e3 * triton_seconds(scene):.2f} ms, {1e3 * batched_seconds(scene):.2f} ms"
        '0.38 ms, 0.44 ms'
    """
    (batch, channels), (height, width), side = scene.image.shape[:2], scene.output_size, scene.psfs.shape[-1]
    size, blended = scene.image.element_size(), 1 if scene.layer_weight is None else 2
    taps = batch * channels * height * width * side**2
    if scene.compositing == "gather":
        loaded, operations = size * (1 + blended), 2 * blended
    elif scene.compositing == "scatter":
        loaded, operations = size * 2 * blended + INDEX_BYTES, 2 + 3 * (blended - 1)
    else:
        taps *= len(scene.psfs)
        loaded, operations = size * (1 + blended) + INDEX_BYTES, 8 + 2 * blended
    slower = size // 4  # float64 has half the rate
    seconds = max(taps * loaded / profile.cache_bytes, taps * operations * slower / profile.flops)
    return LAUNCHES["triton"] * profile.launch + seconds


def batched_seconds(scene: LayeredScene, profile: GpuProfile = H100) -> float:
    """Return the least time of transforms of all layers, see :mod:`kornia_tidy.render.backends.batched`.

    Args:
        scene: to be rendered.
        profile: of the GPU.
    """
    batch, channels, height, width = scene.image.shape
    height, width = padded_size(height, width, scene.psfs.shape[-1], scene.border)
    samples, size = batch * channels * len(scene.psfs) * height * width, scene.image.element_size()
    if scene.compositing == "occlusion":
        samples, size = 3 * samples, 8  # light, alpha and cumulative alpha, in float64
    return LAUNCHES["batched"] * profile.launch + PASSES * size * samples / profile.memory_bytes


def triton_is_allowed() -> bool:
    """Return whether ``method="auto"`` may take kernels in Triton: with ``KORNIA_TIDY_TRITON=on``, else not.

    They were never run on a GPU, only compiled for it and run in Triton's interpreter.

    Example:
        >>> triton_is_allowed()
        False
    """
    return os.environ.get("KORNIA_TIDY_TRITON", "off") == "on"


def is_triton_faster(scene: LayeredScene, profile: GpuProfile = H100) -> bool:
    """Return whether direct convolution is estimated to be faster than transforms by more than :data:`GAIN`.

    Args:
        scene: to be rendered.
        profile: of the GPU.
    """
    return GAIN * triton_seconds(scene, profile) < batched_seconds(scene, profile)
