"""Rows of gradients, and of training to its limits."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy import DwellTimes, PixelwiseMask, SensorNoise, TiDyOptics
from tests.extremes.exposure import camera, random_heights
from tests.extremes.row import Row, scene, worst

GROUP = "Gradients"
SLOPES = "central differences in float64, relative"
# Central differences with a step h = 1e-5 are off by h^2 / 6 of the third derivative and 1e-16 / h of rounding.
SLOPE_BOUND = 1e-5
STEP = 1e-5
STEPS = 10_000


def slope_error(function: Callable[[Tensor], Tensor], at: Tensor, seed: int = 0) -> float:
    """Return the error of the derivative along a random direction, relative to gradient times direction."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(at.shape, generator=generator, dtype=at.dtype)
    leaf = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    if not bool(gradient.isfinite().all()):
        return math.nan
    with torch.no_grad():
        measured = (function(at + STEP * direction) - function(at - STEP * direction)) / (2 * STEP)
    scale = float(gradient.norm() * direction.norm()) or 1.0
    return abs(float((gradient * direction).sum() - measured)) / scale


def of_masks(optics: TiDyOptics, depth: Tensor | None = None, **noise: object) -> float:
    """Return the error of the gradient with respect to the masks' phase."""
    optics = optics.double()
    image, depths = scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def loss(phase: Tensor) -> Tensor:
        captured = torch.func.functional_call(
            optics, {"masks.phase": phase}, (image, depths if depth is None else depth), noise
        )
        return (captured * weights).sum()

    return slope_error(loss, optics.masks.phase.detach().double())


def of_image(optics: TiDyOptics, image: Tensor) -> float:
    """Return the error of the gradient with respect to the image."""
    optics, (_, depth) = optics.double(), scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return slope_error(lambda leaf: (optics(leaf, depth) * weights).sum(), image)


def _finite(optics: TiDyOptics, image: Tensor, depth: Tensor) -> float:
    """0 if a capture and the gradients of image and masks are finite in float32; else NaN."""
    leaf = image.float().requires_grad_()
    captured = optics(leaf, depth.float(), generator=torch.Generator().manual_seed(0))
    captured.square().sum().backward()
    parts = [captured, leaf.grad, optics.masks.phase.grad]
    return 0.0 if all(part is not None and bool(part.isfinite().all()) for part in parts) else math.nan


def _ends() -> Tensor:
    """Depths at the ends of the camera's range and between two layers."""
    near, far = camera().camera.depth_range
    assert math.isinf(far)
    columns = torch.tensor([near, math.inf, 0.595], dtype=torch.float64)[torch.arange(44) % 3]
    return columns.expand(1, 1, 40, 44).contiguous()


def _dark() -> float:
    image, depth = scene()
    return worst(
        [
            _finite(camera(color_space="srgb", sensor=sensor), factor * image, depth)
            for sensor in (None, SensorNoise(0.01), SensorNoise(0.0, full_well=10.0))
            for factor in (0.0, 1.0, 16.0)
        ]
    )


def _huge_slopes() -> float:
    image, depth = scene()
    optics = camera()
    (1e30 * optics(image.float(), depth.float())).sum().backward()
    gradient = optics.masks.phase.grad
    return 0.0 if gradient is not None and bool(gradient.isfinite().all()) else math.nan


def _steps(start: str, *, autocast: bool) -> float:
    """10,000 steps of Adam towards sharp captures; 0 if nothing was NaN or infinite on the way."""
    generator = torch.Generator().manual_seed(0)
    optics = TiDyOptics(
        PixelwiseMask(2, 9, initial=start, generator=generator),
        fidelity=camera().fidelity.replace(window=9, layer_spacing=8.0),
        sensor=SensorNoise(0.01),
    )
    optimizer = torch.optim.Adam(optics.parameter_groups(lr_metres=1e-8), betas=(0.99, 0.999))
    image, depth = (part.float() for part in scene(12, 14))
    for _ in range(STEPS):
        optimizer.zero_grad()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            loss = (optics(image, depth, generator=generator) - image).square().mean()
        loss.backward()
        optimizer.step()
        if not math.isfinite(loss.item()):
            return math.nan
    return 0.0 if bool(optics.masks.phase.isfinite().all()) else math.nan


def _step_in_metres() -> float:
    """Height that the first step of Adam moves, against 1e-8 m, relative."""
    optics = camera().double()
    image, depth = scene()
    before = optics.masks.heights().detach().clone()
    optimizer = torch.optim.Adam(optics.parameter_groups(lr_metres=1e-8), betas=(0.99, 0.999))
    optics(image, depth).square().sum().backward()
    gradient = optics.masks.phase.grad
    assert gradient is not None
    optimizer.step()
    moved = (optics.masks.heights().detach() - before).abs()[gradient.abs() > 1e-9]
    return float((moved / 1e-8 - 1).abs().max())


def rows() -> list[Row]:
    """Return the rows of gradients."""
    flat = torch.zeros(1, 23, 23, dtype=torch.float64)
    image, _ = scene()
    focus = torch.full((1, 1, 40, 44), 0.595, dtype=torch.float64)
    infinity = torch.full_like(focus, math.inf)
    finite = "finite, float32"
    return [
        Row(GROUP, "masks", "random", lambda: of_masks(camera()), SLOPE_BOUND, SLOPES),
        Row(GROUP, "masks", "flat, in focus (psi = 0)", lambda: of_masks(camera(flat), focus), SLOPE_BOUND, SLOPES),
        Row(GROUP, "masks", "flat, at infinity", lambda: of_masks(camera(flat), infinity), SLOPE_BOUND, SLOPES),
        Row(GROUP, "masks", "ends of the range of depth and a layer between",
            lambda: of_masks(camera(fidelity="balanced"), _ends()), SLOPE_BOUND, SLOPES),
        Row(GROUP, "masks", "1e-3 m high", lambda: of_masks(camera(random_heights(1, 23, 1e-3))), SLOPE_BOUND, SLOPES),
        Row(GROUP, "masks", "one of two without time",
            lambda: of_masks(camera(masks=2, modulator=DwellTimes([0.0, 1.0]))), SLOPE_BOUND, SLOPES),
        *(Row(GROUP, "masks", f"compositing {kind}", lambda kind=kind: of_masks(camera(compositing=kind)),
              SLOPE_BOUND, SLOPES, slow=kind == "occlusion") for kind in ("scatter", "occlusion")),
        Row(GROUP, "image", "random, sRGB", lambda: of_image(camera(color_space="srgb"), 0.2 + 0.6 * image),
            SLOPE_BOUND, SLOPES),
        Row(GROUP, "image and masks", "black, usual and 16 in sRGB; no noise, read noise and shot noise", _dark, 0.0,
            finite, "clipped pixels have no gradient; shot noise has that of its mean", slow=True),
        Row(GROUP, "loss", "times 1e30", _huge_slopes, 0.0, finite),
        *(Row(GROUP, "training", f"{STEPS} steps of Adam from {start} masks{', under autocast' * autocast}",
              lambda start=start, autocast=autocast: _steps(start, autocast=autocast), 0.0, "finite throughout",
              slow=True) for start in ("noise", "flat") for autocast in (False, True)),
        Row(GROUP, "training", "learning rate of 1e-8 m, first step", _step_in_metres, 1e-4, "1e-8 m, relative"),
    ]  # fmt: skip
