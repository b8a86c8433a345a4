"""Rows of images: sizes, values, types, memory layouts, threads."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy import LearnableDwellTimes, SensorNoise, TiDyOptics
from tests.extremes.exposure import camera, random_heights
from tests.extremes.lens import BOUND, CAPTURE
from tests.extremes.row import Row, difference, refusals, rounding, scene, worst

GROUP = "Images"
SAME = "the contiguous float32 capture"


def _size(height: int, width: int, batch: int = 1) -> float:
    image, depth = scene(max(height, 1), max(width, 1))
    image, depth = image.expand(batch, -1, -1, -1), depth.expand(batch, -1, -1, -1)
    return rounding(camera(border="replicate"), image, depth)


def _large(height: int, width: int) -> float:
    """Crops at a corner and in the middle of a large capture, against float64 captures of their neighbourhoods."""
    optics = camera()
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(1, 3, height, width, generator=generator)
    depth = 1 / (3.3 * torch.rand(1, 1, height, 1, generator=generator)).expand(1, 1, height, width)
    reach, errors = optics.window, []
    with torch.no_grad():
        whole = optics(image, depth)
        for top, left in ((0, 0), (height // 2, width // 2)):
            part = (..., *(slice(start, start + 64 + 2 * reach) for start in (top, left)))
            double = optics(image[part].double(), depth[part].double())
            inner = (..., *(slice(0 if start == 0 else reach, 64 + reach) for start in (top, left)))
            errors.append(difference(whole[part][inner], double[inner]))
    return worst(errors)


def _scaled(factor: float) -> float:
    """Images of a constant factor, relative to it."""
    image, depth = scene()
    optics = camera()
    with torch.no_grad():
        single = optics((factor * image).float(), depth.float())
        double = optics((factor * image).float().double(), depth.float().double())
    return difference(single / factor, double / factor)


def _linear() -> float:
    """Negative light: the capture is linear, so it is minus that of the image."""
    image, depth = scene()
    optics = camera()
    with torch.no_grad():
        return difference(optics(-image, depth), -optics(image, depth))


def _black() -> float:
    """Brightest value of captures of a black image, in linear light and in sRGB."""
    image, depth = (part.float() for part in scene())
    with torch.no_grad():
        return max(float(camera(color_space=space)(0 * image, depth).abs().max()) for space in ("linear", "srgb"))


def _srgb(value: float) -> float:
    image, depth = scene()
    return rounding(camera(color_space="srgb"), value * torch.ones_like(image), depth)


def _broken(value: float, **options: str) -> Callable[[], object]:
    def attempt() -> object:
        image, depth = scene()
        image[..., 3, 4] = value
        return camera(**options)(image, depth)

    return attempt


def _half(dtype: torch.dtype) -> float:
    """In units of the type's rounding at full scale."""
    image, depth = scene()
    optics = camera()
    with torch.no_grad():
        found = optics(image.to(dtype), depth.float())
        single = optics(image.to(dtype).float(), depth.float())
    assert found.dtype == dtype
    return difference(found, single) / (torch.finfo(dtype).eps / 2)


def _layout(change: Callable[[Tensor], Tensor]) -> float:
    image, depth = (part.float() for part in scene())
    optics = camera()
    with torch.no_grad():
        return difference(optics(change(image), change(depth)), optics(image, depth))


def _strided(tensor: Tensor) -> Tensor:
    return tensor.repeat_interleave(2, -1)[..., ::2]


def _interleaved(tensor: Tensor) -> Tensor:
    return tensor.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)


def _expanded() -> float:
    """One value expanded to a whole image, depth and batch, without memory of its own, against a copy in memory."""
    image, depth = torch.full((1, 1, 1, 1), 0.7).expand(2, 3, 40, 44), torch.full((1,), 0.4).expand(2, 1, 40, 44)
    optics = camera()
    with torch.no_grad():
        return difference(optics(image, depth), optics(image.contiguous(), depth.contiguous()))


def _with_gradients() -> float:
    """Captures with ``requires_grad`` on each input alone and on all, against one without any."""
    image, depth = (part.float() for part in scene())
    shown, options = random_heights(2, 23, 1e-6), {"fidelity": camera().fidelity.replace(layers="linear")}
    captures, leaves = [], ("image", "depth", "masks", "dwell times")
    for wanted in ((), *((name,) for name in leaves), leaves):
        optics = camera(shown, modulator=LearnableDwellTimes((1, 2)), **options).requires_grad_(False)
        optics.masks.requires_grad_("masks" in wanted)
        optics.modulator.requires_grad_("dwell times" in wanted)
        light, distance = (
            part.clone().requires_grad_(name in wanted) for name, part in (("image", image), ("depth", depth))
        )
        captured = optics(light, distance)
        found = {"image": light, "depth": distance, "masks": optics.masks.phase, "dwell times": optics.modulator.logits}
        assert captured.requires_grad == bool(wanted)
        if wanted:
            captured.square().mean().backward()
        for name, leaf in found.items():
            assert (leaf.grad is not None) == (name in wanted), f"{wanted}: {name}"
            assert leaf.grad is None or bool(leaf.grad.isfinite().all()), f"{wanted}: {name}"
        captures.append(captured.detach())
    return worst([difference(captured, captures[0]) for captured in captures])


def _threads(optics: TiDyOptics | None = None) -> float:
    image, depth = (part.float() for part in scene(200, 210))
    optics, before = optics or camera(masks=2), torch.get_num_threads()
    captures = []
    try:
        for threads in (1, 2, 4, 16):
            torch.set_num_threads(threads)
            with torch.no_grad():
                captures.append(optics(image, depth))
    finally:
        torch.set_num_threads(before)
    return worst([difference(captured, captures[0]) for captured in captures])


def _deterministic() -> float:
    """Two runs with torch's deterministic algorithms, gradients included."""
    image, depth = (part.float() for part in scene())
    results = []
    torch.use_deterministic_algorithms(mode=True)
    try:
        for _ in range(2):
            optics = camera(compositing="scatter")
            leaf = image.clone().requires_grad_()
            optics(leaf, depth).square().sum().backward()
            assert leaf.grad is not None
            assert optics.masks.phase.grad is not None
            results.append(torch.cat([leaf.grad.flatten(), optics.masks.phase.grad.flatten()]))
    finally:
        torch.use_deterministic_algorithms(mode=False)
    return difference(*results)


def _empty() -> float:
    """Captures of no image: their values, and the gradient that masks get, which is 0."""
    image, depth = scene()
    found = []
    for kind in ("gather", "scatter", "occlusion"):
        optics = camera(compositing=kind, sensor=SensorNoise(0.01, full_well=1e4))
        leaf = image[:0].clone().requires_grad_()
        captured = optics(leaf, depth[:0])
        assert captured.shape == leaf.shape
        captured.sum().backward()
        gradient = optics.masks.phase.grad
        found += [float(captured.numel()), 0.0 if gradient is None else float(gradient.abs().max())]
    return worst(found)


def rows() -> list[Row]:
    """Return the rows of images."""
    return [
        Row(GROUP, "size, px", "1x1, 1x50, 50x1, 31x47, 97x101", lambda: worst([
            _size(1, 1), _size(1, 50), _size(50, 1), _size(31, 47), _size(97, 101)]), BOUND, CAPTURE,
            "border 'replicate'; 'reflect' needs half a window and says so"),
        Row(GROUP, "size, px", "1024x1024, crops", lambda: _large(1024, 1024), BOUND, CAPTURE, slow=True),
        Row(GROUP, "size, px", "4096x4096, crops", lambda: _large(4096, 4096), BOUND, CAPTURE, slow=True),
        Row(GROUP, "size, px", "8192x8192, crops", lambda: _large(8192, 8192), BOUND, CAPTURE,
            "in bands of rows, as memory_budget asks", slow=True),
        Row(GROUP, "batch", "0: each compositing, noise, gradients", _empty, 0.0, "no value",
            "masks get a gradient of 0"),
        Row(GROUP, "batch", "3", lambda: _size(40, 44, 3), BOUND, CAPTURE),
        Row(GROUP, "values", "0, linear and sRGB", _black, 0.0, "black stays 0"),
        Row(GROUP, "values, linear", "to 1e-30, 1e-3, 1e6, 1e30", lambda: worst(
            [_scaled(factor) for factor in (1e-30, 1e-3, 1e6, 1e30)]), BOUND, "float64, relative to the factor",
            "HDR passes; the camera is linear up to the sensor"),
        Row(GROUP, "values, linear", "negative", _linear, 1e-12, "minus the capture, float64"),
        Row(GROUP, "values, sRGB", "0.5, 1, 16", lambda: worst([_srgb(value) for value in (0.5, 1.0, 16.0)]), BOUND,
            CAPTURE),
        Row(GROUP, "values, sRGB", "negative", lambda: _srgb(-0.5), BOUND, CAPTURE),
        Row(GROUP, "values", "NaN, inf and -inf, linear and sRGB; 1e30 in sRGB", refusals(
            *(_broken(value, color_space=space) for space in ("linear", "srgb")
              for value in (math.nan, math.inf, -math.inf)), _broken(1e30, color_space="srgb")), None),
        Row(GROUP, "type", "float16", lambda: _half(torch.float16), 1.0, "rounding of float16 at 1",
            "computed in float32, rounded once"),
        Row(GROUP, "type", "bfloat16", lambda: _half(torch.bfloat16), 1.0, "rounding of bfloat16 at 1",
            "computed in float32, rounded once"),
        Row(GROUP, "type", "uint8, int64, complex, bool", refusals(*(
            lambda dtype=dtype: camera()(torch.ones(1, 3, 40, 44).to(dtype), torch.ones(1, 1, 40, 44))
            for dtype in (torch.uint8, torch.int64, torch.complex64, torch.bool))), None),
        Row(GROUP, "memory layout", "channels_last, every second column, channels between columns", lambda: worst(
            [_layout(lambda part: part.contiguous(memory_format=torch.channels_last)), _layout(_strided),
             _layout(_interleaved)]), 2e-6, SAME, "the same to rounding: sums may run in another order"),
        Row(GROUP, "memory layout", "one value expanded to image, depth and batch", _expanded, 2e-6,
            "the same in memory, float32"),
        Row(GROUP, "requires_grad", "image, depth, masks, dwell times: each alone, all", _with_gradients, 2e-6,
            "no gradients, float32", "gradients are finite, and there where they are asked for"),
        Row(GROUP, "threads", "1, 2, 4, 16", _threads, 1e-6, "one another, full scale 1",
            "last digits: transforms divide the work by the number of threads"),
        Row(GROUP, "deterministic algorithms", "twice, with gradients", _deterministic, 0.0, "one another"),
    ]  # fmt: skip
