"""A real lens crossed with all else that a camera can have: masks, modulators, motion, bursts, colours, strips."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import kornia_tidy.masks
import kornia_tidy.modulator
from kornia_tidy import DwellTimes, Fidelity, FresnelLens, LearnableDwellTimes, NoMask, SpatialLightModulator, Switching
from kornia_tidy.camera import TiDyOptics, burst, moving_capture
from kornia_tidy.masks import CubicMask, FourierMask, PixelwiseMask, RadialMask, SpiralMask, ZernikeMask
from kornia_tidy.modulator import DiffractionEfficiency, GreyLevels, PixelCrosstalk, StrokeError
from kornia_tidy.optics import Lens, Spectrum, camera_spectrum
from kornia_tidy.psf import PSFModel
from kornia_tidy.psf.field import Field
from tests.base import BaseTester

LENS = Lens.named("single-50mm", 17.6, 0.595, wavelengths=(400e-9, 470e-9, 530e-9, 610e-9, 700e-9))
CENTER = (420.0, -480.0)  # px from the axis, of a picture of 1282x1110 px
PIXELS = ((3, 4), (20, 17), (33, 30))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def masks(count: int = 2) -> PixelwiseMask:
    return PixelwiseMask(count, generator=seeded(3))


SETTINGS = Fidelity(window=13, layer_spacing=10.0, field_tolerance=1e-2)
MASKS: dict[str, Callable[[], nn.Module]] = {
    "CubicMask": lambda: CubicMask(torch.tensor([8.0, 12.0]), 23),
    "FourierMask": lambda: FourierMask(2, 23, generator=seeded()),
    "FresnelLens": lambda: FresnelLens(0.5, 23),
    "NoMask": lambda: NoMask(23),
    "PixelwiseMask": masks,
    "RadialMask": lambda: RadialMask(2, 23, generator=seeded()),
    "SpiralMask": lambda: SpiralMask(2, 46, generator=seeded()),
    "ZernikeMask": lambda: ZernikeMask(2, 23, generator=seeded()),
}
MODULATORS: dict[str, Callable[[], nn.Module]] = {
    "DiffractionEfficiency": lambda: DiffractionEfficiency(0.8),
    "DwellTimes": lambda: DwellTimes((1.0, 3.0)),
    "GreyLevels": lambda: SpatialLightModulator(GreyLevels(3), DwellTimes()),
    "LearnableDwellTimes": lambda: LearnableDwellTimes((1.0, 2.0)),
    "PixelCrosstalk": lambda: SpatialLightModulator(PixelCrosstalk(0.5), DwellTimes()),
    "SpatialLightModulator": lambda: SpatialLightModulator(DwellTimes(), fill_factor=0.9),
    "StrokeError": lambda: SpatialLightModulator(StrokeError(1.05), DwellTimes()),
    "Switching": lambda: Switching(10e-3, 0.1, samples=2),
}


def amplitude() -> Tensor:
    return 0.3 + 0.6 * torch.rand(23, 23, generator=seeded())


def camera(mask: nn.Module | None = None, **parts: object) -> TiDyOptics:
    parts = {"camera": LENS.camera(8e-6), "fidelity": SETTINGS, "spectrum": Spectrum.monochrome(), **parts}
    settings = {"sensor": None, "color_space": "linear", "lens": LENS, "field_center": CENTER, **parts}
    return TiDyOptics(masks() if mask is None else mask, **settings)


def scene(channels: int = 1, height: int = 36, width: int = 40) -> tuple[Tensor, Tensor]:
    steps = torch.rand(1, 1, height // 12, -(-width // 12), generator=seeded(1))
    inverse = 0.2 + 3 * steps.repeat_interleave(12, 2).repeat_interleave(12, 3)[..., :width]
    return torch.rand(1, channels, height, width, generator=seeded(2)), 1 / inverse


def moving(optics: TiDyOptics, image: Tensor, depth: Tensor) -> Tensor:
    """The scene goes two pixels to the right from each mask to the next."""
    shifts = [2 * moment for moment in range(len(optics.timeline(torch.float32).durations))]
    images, depths = (torch.stack([part.roll(s, -1) for s in shifts], 1) for part in (image, depth))
    return moving_capture(optics, images, depths)


def in_shots(optics: TiDyOptics, image: Tensor, depth: Tensor) -> Tensor:
    return burst(optics, image, depth).flatten(1, 2)


def in_strips(optics: TiDyOptics, image: Tensor, depth: Tensor) -> Tensor:
    optics.memory_budget = 1
    return optics(image, depth)


def at_once(optics: TiDyOptics, image: Tensor, depth: Tensor) -> Tensor:
    return optics(image, depth)


FEATURES: dict[str, tuple[Callable[[], TiDyOptics], Callable[..., Tensor]]] = {
    **{f"masks {name}": (lambda make=make: camera(make()), at_once) for name, make in MASKS.items()},
    **{f"modulator {name}": (lambda make=make: camera(modulator=make()), at_once) for name, make in MODULATORS.items()},
    "motion": (camera, moving),
    "motion and switching": (lambda: camera(modulator=Switching(10e-3, 0.1, samples=2)), moving),
    "burst": (camera, in_shots),
    "strips": (camera, in_strips),
    "colours": (lambda: camera(spectrum=Spectrum.rgb()), at_once),
    "many wavelengths": (lambda: camera(spectrum=camera_spectrum(samples=4)), at_once),
    "reflectance spectra": (lambda: camera(spectrum=camera_spectrum(samples=4, reflectance=True)), at_once),
    "amplitudes": (lambda: camera(aperture=amplitude()), at_once),
    "learnt amplitudes": (lambda: camera(aperture=nn.Parameter(amplitude())), at_once),
    "veil": (lambda: camera(fidelity=SETTINGS.replace(stray_light="veil")), at_once),
    "cubic layers": (lambda: camera(fidelity=SETTINGS.replace(layers="cubic")), at_once),
    "nearest layers": (lambda: camera(fidelity=SETTINGS.replace(layers="nearest")), at_once),
    "occlusion": (lambda: camera(compositing="occlusion", fidelity=SETTINGS.replace(occlusion_states="mean")), at_once),
    "occlusion of each state": (lambda: camera(compositing="occlusion"), at_once),
    "occlusion and motion": (lambda: camera(compositing="occlusion"), moving),
}  # fmt: skip


class TestEveryFeature(BaseTester):
    def test_feature_none_is_left_out(self):
        """Of the classes that are public; the base class of masks is none of its own."""
        public = {name for name in kornia_tidy.masks.__all__ if isinstance(getattr(kornia_tidy.masks, name), type)}
        assert set(MASKS) == public - {"PhaseMasks"}
        assert set(MODULATORS) == set(kornia_tidy.modulator.__all__)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("feature", FEATURES)
    @torch.no_grad()
    def test_feature_a_pixel_sees_through_the_psf_of_its_place(self, feature, monkeypatch):
        """The whole picture is taken through one pixel's PSFs, by the same camera, which must give that pixel."""
        make, take = FEATURES[feature]
        optics = make()
        image, depth = scene(len(optics.spectrum.weights))
        seen, lost, moved = take(optics, image, depth), [], []
        for y, x in PIXELS:
            where = (CENTER[0] + y - 17.5, CENTER[1] + x - 19.5)
            for center, found in ((where, lost), ((0.0, 0.0), moved)):
                monkeypatch.setattr(PSFModel, "field_of", lambda _, size, __, c=center: Field(size, (1, 1), c))
                own = take(make(), image, depth)
                found.append(float((own - seen)[..., y, x].abs().max()))
        assert max(lost) < (4e-3 if "occlusion" in feature else 2e-3)  # of full scale
        assert max(moved) > 5 * max(lost)


class TestGradients(BaseTester):
    @pytest.mark.parametrize(
        ("border", "real", "bound"),
        [("reflect", torch.float32, 1e-6), ("zero", torch.float64, 1e-12), ("valid", torch.float64, 1e-12)],
    )
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    @pytest.mark.parametrize("lens", [None, LENS])
    def test_feature_that_of_the_light_is_the_adjoint(self, lens, compositing, border, real, bound):
        """<A u, v> = <u, A' v>: in parts of |A u| |v|, and of the product itself where all of v is above zero.

        Of two images; with masks that learn, with kept PSFs, and in strips.
        """
        fidelity = SETTINGS.replace(double=real == torch.float64)
        optics = camera(lens=lens, compositing=compositing, border=border, fidelity=fidelity).to(real)
        images, depths = zip(*(scene(height=72, width=w) for w in (84, 92)), strict=True)
        light, depth = (torch.cat([x[..., :84] for x in parts]).to(real) for parts in (images, depths))
        light.requires_grad_()
        for take in (at_once, at_once, in_strips):
            seen = take(optics, light, depth)
            for draw, seed in ((torch.rand, 9), (torch.randn, 10)):
                other = draw(seen.shape, generator=seeded(seed), dtype=torch.float64).to(real)
                (back,) = torch.autograd.grad(seen, light, other, retain_graph=True)
                pairs = [(a.detach().double(), b.detach().double()) for a, b in ((seen, other), (light, back))]
                one, two = (float((a * b).sum()) for a, b in pairs)
                size = abs(one) if draw is torch.rand else float(pairs[0][0].norm() * pairs[0][1].norm())
                assert abs(one - two) < bound * size
            optics.requires_grad_(False)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_gradcheck_along_directions(self, compositing):
        """To masks, dwell times and amplitude, against the difference of two captures, to 1e-3."""
        settings = SETTINGS.replace(double=True, occlusion_states="mean")
        parts = {"fidelity": settings, "compositing": compositing, "modulator": LearnableDwellTimes((1.0, 2.0))}
        optics = camera(aperture=nn.Parameter(amplitude()), **parts).double()
        image, depth = (part.double() for part in scene())
        weight = torch.rand(image.shape, generator=seeded(5)).double()
        (optics(image, depth) * weight).sum().backward()
        for parameter in (optics.masks.phase, optics.modulator.logits, optics.aperture.amplitude):
            direction = torch.rand(parameter.shape, generator=seeded(6), dtype=torch.float64) - 0.5
            expected, ends = float((parameter.grad * direction).sum()), []
            with torch.no_grad():
                for step in (-1e-4, 2e-4):
                    parameter.add_(step * direction)
                    ends.append(float((optics(image, depth) * weight).sum()))
                parameter.sub_(1e-4 * direction)
            assert (ends[1] - ends[0]) / 2e-4 == pytest.approx(expected, rel=1e-3)
