"""Extreme settings in pairs: every capture and gradient is finite and as exact as float32, or refused in one sentence.

Settings of different axes are combined two by two. ``--runslow`` takes all pairs, the test suite a fixed sample.
"""

from __future__ import annotations

import itertools
import math
import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.optics import DefocusRange, Spectrum, ThinLensCamera
from tests.base import BaseTester

BOUND = 1e-4  # of full scale: float32 against float64
SAMPLE = 24  # pairs in the test suite
INF = math.inf


@dataclass(frozen=True, eq=False)
class Setting:
    """An extreme value of one axis."""

    axis: str
    name: str
    options: dict[str, object] = field(default_factory=dict)  # of TiDyOptics
    fidelity: dict[str, object] = field(default_factory=dict)  # what is replaced
    masks: tuple[int, int, float] | None = None  # K, N, largest height in metres
    image: Callable[[Tensor], Tensor] | None = None
    depth: Callable[[Tensor], Tensor] | None = None
    size: tuple[int, int] | None = None
    dtype: torch.dtype | None = None

    def __str__(self) -> str:
        return f"{self.axis} {self.name}"


def lens(**values: object) -> dict[str, object]:
    return {"camera": ThinLensCamera(**values)}


def ring(size: int) -> Tensor:
    place = torch.linspace(-1, 1, size)
    radius = (place[:, None].square() + place.square()).sqrt()
    return ((radius <= 1) & (radius > 0.9)).float()


def one_pixel(size: int) -> Tensor:
    amplitude = torch.zeros(size, size)
    amplitude[size // 2, size // 2] = 1.0
    return amplitude


def checkered(depth: Tensor, near: float, far: float) -> Tensor:
    rows, columns = (torch.arange(side) for side in depth.shape[-2:])
    return torch.where((rows[:, None] + columns) % 2 == 0, near, far).to(depth).expand_as(depth).contiguous()


def one_odd(depth: Tensor, value: float) -> Tensor:
    depth = torch.full_like(depth, 1.0)
    depth[..., -1, -1] = value
    return depth


SETTINGS = [
    Setting("depth", "1e-6 m", depth=lambda depth: torch.full_like(depth, 1e-6)),
    Setting("depth", "1e12 m", depth=lambda depth: torch.full_like(depth, 1e12)),
    Setting("depth", "inf", depth=lambda depth: torch.full_like(depth, INF)),
    Setting("depth", "checkerboard of 0.3 m and inf", depth=lambda depth: checkered(depth, 0.3, INF)),
    Setting("depth", "one pixel at 1e-6 m", depth=lambda depth: one_odd(depth, 1e-6)),
    Setting("depth", "0 beside 1 m", depth=lambda depth: one_odd(depth, 0.0)),
    Setting("depth", "NaN beside 1 m", depth=lambda depth: one_odd(depth, math.nan)),
    Setting("lens", "focus at infinity", lens(focus_distance=INF, depth_range=(5.0, INF))),
    Setting("lens", "macro", lens(focus_distance=0.0501, depth_range=(0.05005, 0.05015))),
    Setting("lens", "f/0.5", lens(aperture_diameter=0.1, focus_distance=1.0, depth_range=(0.9995, 1.0005))),
    Setting("lens", "f/500", lens(aperture_diameter=1e-4)),
    Setting("lens", "pixels of 0.1 mm", lens(pixel_pitch=1e-4)),
    Setting("lens", "defocus of 60 rad", {"camera": DefocusRange(-60.0, 60.0)}),
    Setting("lens", "no defocus", {"camera": DefocusRange(0.0, 1e-9)}),
    Setting("wavelength", "200 nm", {"spectrum": Spectrum((200e-9,), ((1.0,),) * 3)}),
    Setting("wavelength", "20 um", {"spectrum": Spectrum((20e-6,), ((1.0,),) * 3)}),
    Setting("wavelength", "both", {"spectrum": Spectrum((200e-9, 20e-6), ((1.0, 0.0), (0.5, 0.5), (0.0, 1.0)))}),
    Setting("masks", "flat", masks=(1, 23, 0.0)),
    Setting("masks", "1 mm high", masks=(1, 23, 1e-3)),
    Setting("masks", "1 pixel", masks=(1, 1, 1e-6)),
    Setting("masks", "K = 40", masks=(40, 23, 1e-6)),
    Setting("masks", "one of two shown", {"modulator": DwellTimes([0.0, 1.0])}, masks=(2, 23, 1e-6)),
    Setting("masks", "dwell times 1e-30 and 1", {"modulator": DwellTimes([1e-30, 1.0])}, masks=(2, 23, 1e-6)),
    Setting("aperture", "one pixel", {"aperture": one_pixel(23)}),
    Setting("aperture", "ring", {"aperture": ring(23)}),
    Setting("image", "0", image=torch.zeros_like),
    Setting("image", "1e-30", image=lambda image: 1e-30 * image),
    Setting("image", "1e6", image=lambda image: 1e6 * image),
    Setting("image", "negative", image=lambda image: -image),
    Setting("image", "one bright pixel", image=lambda image: one_odd(image, 0.0).eq(0).to(image)),
    Setting("size", "1x1", size=(1, 1)),
    Setting("size", "1x19", size=(1, 19)),
    Setting("size", "23x1", size=(23, 1)),
    Setting("size", "31x17", size=(31, 17)),
    Setting("compositing", "scatter", {"compositing": "scatter"}),
    Setting("compositing", "occlusion", {"compositing": "occlusion"}),
    Setting("border", "zero", {"border": "zero"}),
    Setting("border", "circular", {"border": "circular"}),
    Setting("border", "valid", {"border": "valid"}),
    Setting("border", "reflect", {"border": "reflect"}),
    Setting("window", "1 px", fidelity={"window": 1}),
    Setting("window", "101 px", fidelity={"window": 101}),
    Setting("layers", "linear", fidelity={"layers": "linear"}),
    Setting("layers", "cubic", fidelity={"layers": "cubic"}),
    Setting("layers", "band-limited", fidelity={"layers": "bandlimited"}),
    Setting("layers", "1000 rad apart", fidelity={"layer_spacing": 1000.0}),
    Setting("stray light", "veil", fidelity={"stray_light": "veil"}),
    Setting("stray light", "discard", fidelity={"stray_light": "discard"}),
    Setting("color", "srgb", {"color_space": "srgb"}),
    Setting("sensor", "full well of 1", {"sensor": SensorNoise(0.0, full_well=1.0)}),
    Setting("sensor", "full well of 1e12", {"sensor": SensorNoise(0.0, full_well=1e12)}),
    Setting("sensor", "1 bit, much read noise", {"sensor": SensorNoise(1.0, bits=1)}),
    Setting("type", "float16", dtype=torch.float16),
    Setting("type", "bfloat16", dtype=torch.bfloat16),
    Setting("type", "float64", dtype=torch.float64),
]  # fmt: skip

PAIRS = [pair for pair in itertools.combinations(SETTINGS, 2) if pair[0].axis != pair[1].axis]


def camera_of(*settings: Setting) -> TiDyOptics:
    """Return a camera with the settings, which has no noise, linear light and the border "replicate" otherwise."""
    count, size, highest = next((setting.masks for setting in settings if setting.masks), (2, 23, 1e-6))
    generator = torch.Generator().manual_seed(0)
    heights = highest * torch.rand(count, size, size, generator=generator, dtype=torch.float64)
    options: dict = {"sensor": None, "color_space": "linear", "border": "replicate"}
    changes: dict = {"window": 15}
    for setting in settings:
        options.update(setting.options)
        changes.update(setting.fidelity)
    fidelity = Fidelity.preset("draft").replace(**changes)
    return TiDyOptics(PixelwiseMask(initial=heights), fidelity=fidelity, **options)


def scene_of(*settings: Setting, normalised: bool) -> tuple[Tensor, Tensor]:
    """Return image and depth in float64, or disparity where the camera takes that."""
    height, width = next((setting.size for setting in settings if setting.size), (20, 22))
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 3, height, width, generator=generator, dtype=torch.float64)
    depth = torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    depth = depth if normalised else 0.3 / depth
    for setting in settings:
        image = setting.image(image) if setting.image else image
        depth = setting.depth(depth) if setting.depth else depth
    return image, depth


def outcome(*settings: Setting) -> str | float:
    """Return the error of float32, full scale 1, or the sentence of a refusal.

    Raises:
        AssertionError: if a capture or gradient is not finite, an error beyond the bound, or a refusal no sentence.
    """
    label = " and ".join(map(str, settings))
    try:
        optics = camera_of(*settings)
        image, depth = scene_of(*settings, normalised=isinstance(optics.camera, DefocusRange))
        dtype = next((setting.dtype for setting in settings if setting.dtype), torch.float32)
        image = image.to(dtype).requires_grad_()
        depth = depth.float()
        taken = optics(image, depth, generator=torch.Generator().manual_seed(2))
    except (ValueError, TypeError) as error:
        sentence = str(error)
        assert sentence, f"{label}: no sentence"
        assert "\n" not in sentence, f"{label}: {sentence}"
        return sentence
    assert taken.dtype == dtype, f"{label}: {taken.dtype}"
    assert bool(taken.isfinite().all()), f"{label}: the capture is not finite"
    if taken.numel():
        taken.float().square().mean().backward()
        for name, leaf in (("image", image), ("masks", optics.masks.phase)):
            assert leaf.grad is not None, f"{label}: {name} has no gradient"
            assert bool(leaf.grad.isfinite().all()), f"{label}: the gradient of {name} is not finite"
    if optics.sensor is not None or not taken.numel():
        return 0.0
    with torch.no_grad():
        exact = optics(image.detach().double(), depth.double())
    scale = max(1.0, float(image.detach().abs().max()))
    error = float((taken.detach().double() - exact).abs().max()) / scale
    rounding = 0.0 if dtype == torch.float32 else torch.finfo(dtype).eps
    assert error <= BOUND + rounding, f"{label}: error {error:.3g}"
    return error


def faults(pairs: list[tuple[Setting, ...]]) -> list[str]:
    """Return what went wrong, a line for each pair."""
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clamped depths and narrow windows, which are provoked
        for pair in pairs:
            try:
                outcome(*pair)
            except AssertionError as error:
                found.append(str(error))
    return found


class TestHostilePairs(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_each_extreme_alone_is_exact_or_refused(self):
        assert not faults([(setting,) for setting in SETTINGS])

    def test_feature_extremes_in_pairs_are_exact_or_refused(self):
        assert not faults(random.Random(0).sample(PAIRS, SAMPLE))

    @pytest.mark.parametrize("options", [{"aperture": one_pixel(23)}, {"masks": PixelwiseMask(1, 1)}], ids=["23", "1"])
    def test_feature_bandlimited_layers_of_one_cell(self, options):
        optics = TiDyOptics(fidelity=Fidelity(window=15, layers="bandlimited", layer_spacing=0.5), **options)
        assert optics.psf_bank().psfs.isfinite().all()

    @pytest.mark.slow
    def test_feature_all_pairs_of_extremes_are_exact_or_refused(self):
        assert not faults(PAIRS)
