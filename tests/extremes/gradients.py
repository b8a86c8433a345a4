"""Rows of gradients, and of training to its limits."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy import DwellTimes, LearnableDwellTimes, PixelwiseMask, SensorNoise, TiDyOptics
from tests.extremes.exposure import camera, random_heights
from tests.extremes.row import Row, difference, scene, worst

GROUP = "Gradients"
SLOPES = "central differences in float64, relative"
# Central differences with a step h = 1e-5 are off by h^2 / 6 of the third derivative and 1e-16 / h of rounding.
SLOPE_BOUND = 1e-5
STEP = 1e-5
STEPS = 10_000


def slope_error(function: Callable[[Tensor], Tensor], at: Tensor, seed: int = 0, step: float = STEP) -> float:
    """Return the error of the derivative along a random direction, relative to gradient times direction."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(at.shape, generator=generator, dtype=at.dtype)
    leaf = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    if not bool(gradient.isfinite().all()):
        return math.nan
    with torch.no_grad():
        measured = (function(at + step * direction) - function(at - step * direction)) / (2 * step)
    scale = float(gradient.norm() * direction.norm()) or 1.0
    return abs(float((gradient * direction).sum() - measured)) / scale


def of_masks(optics: TiDyOptics, depth: Tensor | None = None, brightness: float = 1.0) -> float:
    """Return the error of the gradient with respect to the masks' phase."""
    optics = optics.double()
    image, depths = scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def loss(phase: Tensor) -> Tensor:
        captured = torch.func.functional_call(
            optics, {"masks.phase": phase}, (brightness * image, depths if depth is None else depth)
        )
        return (captured * weights).sum()

    return slope_error(loss, optics.masks.phase.detach().double())


def of_image(optics: TiDyOptics, image: Tensor) -> float:
    """Return the error of the gradient with respect to the image."""
    optics, (_, depth) = optics.double(), scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return slope_error(lambda leaf: (optics(leaf, depth) * weights).sum(), image)


def of_depth(layers: str) -> float:
    """Return the error of the gradient with respect to depths of 0.3 to 5 m, where layers are blended."""
    optics = camera(fidelity=camera().fidelity.replace(layers=layers)).double()
    image, depth = scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    # Gradients jump at the layers; of 1760 depths that move by 1e-7 m none lies as near to one.
    return slope_error(lambda leaf: (optics(image, leaf) * weights).sum(), depth.clamp(max=5.0), step=1e-7)


def _far_depths() -> float:
    """Largest gradient with respect to depths at infinity and beyond the range, where a capture does not change."""
    found = []
    for value in (math.inf, 1e-6):
        image, depth = (part.float() for part in scene())
        leaf = torch.full_like(depth, value).requires_grad_()
        camera(fidelity="balanced")(image, leaf).sum().backward()
        assert leaf.grad is not None
        found.append(difference(leaf.grad, torch.zeros_like(leaf.grad)))
    return worst(found)


def of_dwell_times(*shares: float) -> float:
    """Return the error of the gradient with respect to learnable dwell times."""
    optics, (image, depth) = camera(masks=len(shares), modulator=LearnableDwellTimes(shares)).double(), scene()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def loss(logits: Tensor) -> Tensor:
        captured = torch.func.functional_call(optics, {"modulator.logits": logits}, (image, depth))
        return (captured * weights).sum()

    return slope_error(loss, optics.modulator.logits.detach().double(), step=1e-4)


def _no_photons() -> float:
    """Gradients of black images: with shot noise they are those of its mean, the light itself."""
    gradients = []
    for sensor in (None, SensorNoise(0.0, full_well=10.0)):
        image, depth = scene()
        leaf = (0 * image).requires_grad_()
        (camera(sensor=sensor)(leaf, depth) * image).sum().backward()
        assert leaf.grad is not None
        gradients.append(leaf.grad)
    return difference(*gradients)


def _clipped() -> Tensor:
    """An image in sRGB that has usual values and values above 1, none near 1."""
    image, _ = scene()
    return torch.where(image > 0.5, 1.5 + image, 0.2 + image / 2)


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
        Row(GROUP, "masks", "half of the sensor's pixels saturated, linear",
            lambda: of_masks(camera(sensor=SensorNoise(0.0)), brightness=2.0), SLOPE_BOUND, SLOPES),
        Row(GROUP, "dwell times", "learnt: 1, 2 and 3; 0.05 beside 1", lambda: worst(
            [of_dwell_times(1, 2, 3), of_dwell_times(0.05, 1)]), SLOPE_BOUND, SLOPES),
        *(Row(GROUP, "depth", f"0.3 to 5 m, layers {layers}", lambda layers=layers: of_depth(layers), SLOPE_BOUND,
              SLOPES, slow=layers != "linear") for layers in ("linear", "cubic", "bandlimited")),
        Row(GROUP, "depth", "infinity; nearer than the camera's range", _far_depths, 0.0, "0, float32",
            "1/z is flat at infinity; clamped depths have no gradient"),
        Row(GROUP, "image", "dark: 0 linear, 0 and 0.001 to 0.002 sRGB", lambda: worst(
            [of_image(camera(), 0 * image), *(of_image(camera(color_space="srgb"), dark)
                                              for dark in (0 * image, 1e-3 + 1e-3 * image))]), SLOPE_BOUND, SLOPES),
        Row(GROUP, "image", "clipped: a part at 2 and above in sRGB",
            lambda: of_image(camera(color_space="srgb"), _clipped()), SLOPE_BOUND, SLOPES),
        Row(GROUP, "image", "saturated: all of the sensor",
            lambda: of_image(camera(sensor=SensorNoise(0.0)), 2 + image), 0.0, SLOPES,
            "clipped pixels have no gradient"),
        Row(GROUP, "image", "black with shot noise: no photons", _no_photons, 1e-12, "without noise, float64"),
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
