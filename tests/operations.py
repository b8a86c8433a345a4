"""Public operations on tensors, made small: what tests/test_kinds.py runs kornia's kinds of test on.

Each is a function that takes an example of one tensor, its argument, and returns the operation on that argument with
all else bound: other tensors, modules, the draws of what is random.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import kornia.augmentation as K
import torch
from torch import Tensor

from kornia_tidy import SensorNoise, masks, modulator, optics, reconstruction, render, sensor
from kornia_tidy import augmentation as ours
from kornia_tidy.camera import burst, moving_capture
from kornia_tidy.data import fill_holes
from kornia_tidy.optics import DefocusRange, ThinLensCamera
from kornia_tidy.psf import PSFBank
from tests.camera.pipeline_samples import camera

Call = Callable[[Tensor], Tensor]
IMAGE, DEPTH, PHASE = (3, 12, 16), (1, 12, 16), (9, 9)
LENS: dict[str, Any] = {"focal_length": 10e-3, "pixel_pitch": 4e-6}
NODES = (-8.0, 0.0, 8.0)


class Operation(NamedTuple):
    """Operation on one tensor, with the argument it takes and the properties it has."""

    make: Callable[[Tensor], Call]
    shape: tuple[int, ...] = IMAGE
    """Of one item of the argument."""
    ends: tuple[float, float] = (0.1, 0.9)
    """The argument is uniform between them."""
    out: tuple[int, ...] | None = None
    """Shape of one item of the result. None: that of the argument."""
    error: str = "must be floating point"
    """In the sentence that an argument of whole numbers gets."""
    allows: str = ""
    """Why whole numbers are allowed. Empty: they are not."""
    stepped: str = ""
    """Why there is no gradient to be checked. Empty: there is one."""
    halves: str = ""
    """Sentence with which half precision is refused. Empty: it is allowed."""
    least: int = 0
    """Items that there must be."""
    slow_to_compile: bool = False
    """Whether compiling it takes seconds (kornia's containers, loops over states) or is tested in its own file too."""
    wide: bool = False
    """Whether float32 comes out for half precision: weights and sums, not images."""


class MarkDepth(ours.DepthAugmentation):
    """Writes the depth that it is given into the first channel, where the optics would blur by it."""

    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([depth.expand(len(image), -1, -1, -1).to(image), image[:, 1:]], 1)


def wide_type(image: Tensor) -> torch.dtype:
    return torch.promote_types(image.dtype, torch.float32)


def depth_for(image: Tensor) -> Tensor:
    """0.4 m to 1.4 m, in float32 or better, the same for each data type."""
    shape = (*image.shape[:-3], 1, *image.shape[-2:])
    return (0.4 + torch.rand(shape, generator=torch.Generator().manual_seed(3))).to(wide_type(image))


def bank_for(image: Tensor) -> PSFBank:
    psfs = torch.rand(3, 3, 5, 5, generator=torch.Generator().manual_seed(4)) / 25
    psfs[..., 2, 2] += 0.5
    dtype = wide_type(image)
    return PSFBank.from_measured(psfs.to(dtype), torch.tensor(NODES, dtype=dtype))


def with_depth(make: Callable[[], Callable[..., Any]], part: int | None = None) -> Callable[[Tensor], Call]:
    """An operation on image and depth; ``part`` names the image among what it returns."""

    def bound(image: Tensor) -> Call:
        function, depth = make(), depth_for(image)
        return (lambda x: function(x, depth)) if part is None else (lambda x: function(x, depth)[part])

    return bound


def drawn(make: Callable[[], K.IntensityAugmentationBase2D], depth: bool = False) -> Callable[[Tensor], Call]:
    """An augmentation that repeats one draw."""

    def bound(image: Tensor) -> Call:
        augmentation, given = make(), (depth_for(image),) if depth else ()
        with torch.random.fork_rng():
            torch.manual_seed(1)
            params = augmentation.forward_parameters(image.shape)
        return lambda x: augmentation(x, *given, params=params)

    return bound


def rendered(function: Callable[..., Tensor]) -> Callable[[Tensor], Call]:
    def bound(image: Tensor) -> Call:
        bank, defocus = bank_for(image), 16 * (depth_for(image) - 0.9)
        return lambda x: function(x, defocus, bank.defocus, bank.psfs)

    return bound


def rendered_bank(image: Tensor) -> Call:
    bank, defocus = bank_for(image), 16 * (depth_for(image) - 0.9)
    return lambda x: render.render(x, defocus, bank)


def restored(make: Callable[[], Callable[..., Tensor]]) -> Callable[[Tensor], Call]:
    def bound(image: Tensor) -> Call:
        bank, function = bank_for(image), make()
        return lambda x: function(x, bank)

    return bound


def noisy(image: Tensor) -> Call:
    noise = SensorNoise(0.01, full_well=1000.0)
    fields = noise.draw(image.shape, dtype=wide_type(image), generator=torch.Generator().manual_seed(2))
    return lambda x: noise(x, params=fields)


def drawn_shot(electrons: Tensor) -> Call:
    uniform = torch.rand(electrons.shape, generator=torch.Generator().manual_seed(2)).to(wide_type(electrons))
    return lambda x: sensor.shot_noise(x, uniform)


def of_moments(images: Tensor) -> Call:
    optics_, depths = camera(sensor=None), depth_for(images)
    return lambda x: moving_capture(optics_, x, depths)


def bound_sequence(image: Tensor) -> Call:
    chain, depth = K.ImageSequential(ours.RandomDepthBlur((0.6, 0.6), (4.0, 4.0), p=1.0, **LENS)), depth_for(image)

    def call(x: Tensor) -> Tensor:
        with ours.bound_depth(chain, depth):
            return chain(x)

    return call


def tapped(image: Tensor) -> Call:
    marked, depth = MarkDepth(p=1.0), depth_for(image)
    chain = K.AugmentationSequential(marked.depth_tap, marked, data_keys=["input", "mask"])
    return lambda x: chain(x, depth)[0]


def holes(depth: Tensor) -> Call:
    valid = torch.rand(depth.shape, generator=torch.Generator().manual_seed(3)) > 0.4
    return lambda x: fill_holes(x.masked_fill(~valid.to(x.device), 0))[0]


def first(module: Callable[[Tensor], tuple[Tensor, ...]]) -> Callable[[Tensor], Call]:
    return lambda _: lambda x: module(x)[0]


def plain(function: Call) -> Callable[[Tensor], Call]:
    return lambda _: function


LEVELS = "levels are steps: tests/modulator/test_phase_panel.py tests the gradient that is passed through"
SHOT = "shot noise of less than 25 electrons has steps: sensor_noise is checked above"
RADIANS = "whole radians are radians"
PHASES = "phases of a module of this package, never of a file"
FLIP = K.RandomHorizontalFlip(p=1.0)

OPERATIONS = {
    "TiDyOptics": Operation(with_depth(lambda: camera(sensor=None)), slow_to_compile=True),
    "burst": Operation(with_depth(lambda: partial(burst, camera(sensor=None))), out=(5, *IMAGE), slow_to_compile=True),
    "moving_capture": Operation(of_moments, shape=(5, *IMAGE), out=IMAGE, slow_to_compile=True),
    "thin_lens_defocus": Operation(
        plain(lambda x: optics.thin_lens_defocus(x, 1.4e-3, 0.6)), DEPTH, (0.4, 1.4), allows="whole metres are metres"
    ),
    "ThinLensCamera": Operation(plain(ThinLensCamera().defocus), DEPTH, (0.4, 1.4), allows="whole metres are metres"),
    "DefocusRange": Operation(plain(DefocusRange().defocus), DEPTH, allows="0 and 1 are disparities"),
    "SensorNoise": Operation(noisy),
    "shot_noise": Operation(drawn_shot, ends=(50.0, 500.0), allows="electrons are whole numbers"),
    "quantize": Operation(plain(lambda x: sensor.quantize(x, 8)), stepped="levels are steps, passed straight through"),
    "render": Operation(rendered_bank),
    "gather": Operation(rendered(render.gather)),
    "scatter": Operation(rendered(render.scatter)),
    "occlusion": Operation(rendered(render.occlusion)),
    "layer_weights": Operation(
        lambda i: lambda x: render.layer_weights(x, torch.tensor(NODES, dtype=wide_type(i)), "linear"),
        DEPTH,
        (-7.0, 7.0),
        out=IMAGE,
        allows=RADIANS,
        wide=True,
    ),
    "assign_layers": Operation(
        lambda i: lambda x: render.assign_layers(x, torch.tensor(NODES, dtype=wide_type(i)), "linear")[1],
        DEPTH,
        (-7.0, 7.0),
        allows=RADIANS,
        wide=True,
    ),
    "Wiener": Operation(restored(reconstruction.Wiener), slow_to_compile=True),
    "Tikhonov": Operation(restored(reconstruction.Tikhonov)),
    "TikhonovLayers": Operation(restored(reconstruction.TikhonovLayers), out=(3, *IMAGE)),
    "GreyLevels": Operation(plain(modulator.GreyLevels(4)), PHASE, (0.0, 7.0), stepped=LEVELS, allows=PHASES),
    "PixelCrosstalk": Operation(plain(modulator.PixelCrosstalk(0.3)), PHASE, (0.0, 7.0), allows=PHASES),
    "StrokeError": Operation(plain(modulator.StrokeError(0.9)), PHASE, (0.0, 7.0), allows=PHASES),
    "central_square": Operation(plain(masks.central_square), (9, 13), (0.0, 7.0), out=PHASE, allows=PHASES),
    "DwellTimes": Operation(first(modulator.DwellTimes()), PHASE, (0.0, 7.0), allows=PHASES, least=1),
    "DepthTap": Operation(
        tapped, error="Expected input of", halves="the container casts masks to the image's type", slow_to_compile=True
    ),
    "DepthBlur": Operation(with_depth(lambda: ours.DepthBlur(0.6, 4.0, **LENS)), slow_to_compile=True),
    "LinearCamera": Operation(lambda i: ours.LinearCamera(camera(sensor=None), depth_for(i))),
    "OpticsPipeline": Operation(
        with_depth(lambda: ours.OpticsPipeline(FLIP, camera(sensor=None)), 0),
        slow_to_compile=True,
    ),
    "RandomDepthBlur": Operation(drawn(lambda: ours.RandomDepthBlur(p=0.7, **LENS), True), slow_to_compile=True),
    "RandomSensorNoise": Operation(
        drawn(lambda: ours.RandomSensorNoise(p=0.7, bits=None)),
        error="Expected input of",
        stepped=SHOT,
        slow_to_compile=True,
    ),
    "RandomTiDyOptics": Operation(
        drawn(lambda: ours.RandomTiDyOptics(camera(sensor=None), exposure=(0.5, 1.0), p=0.7), True),
        slow_to_compile=True,
    ),
    "SceneGeometry": Operation(with_depth(lambda: ours.SceneGeometry(FLIP), 0), slow_to_compile=True),
    "bound_depth": Operation(bound_sequence, slow_to_compile=True),
    "depth_blur": Operation(
        with_depth(lambda: lambda x, d: ours.depth_blur(x, d, 0.6, 4.0, **LENS)), slow_to_compile=True
    ),
    "fill_holes": Operation(holes, DEPTH, (0.4, 1.4), allows="classes and millimetres may have holes"),
    "sensor_noise": Operation(
        lambda i: (
            lambda x: ours.sensor_noise(
                x, 1e4, 3.0, bits=None, params={"shot": torch.full_like(x, 0.3), "read": torch.full_like(x, 0.7)}
            )
        )
    ),
}
