"""Laws that a capture obeys whatever the camera, the scene and their sizes (hypothesis)."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import torch
from hypothesis import given, settings
from torch import Tensor

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from tests.base import BaseTester

FEW = settings(max_examples=25, derandomize=True)
POSITIVE = ("nearest", "linear")  # cubic and band-limited PSFs between two depths may be negative by 1e-5 of the light
TOLERANCE = 1e-12  # float64: a weighted mean of at most 2 x 9 x 9 values in [0, 1], and transforms of 2^12 of them


@st.composite
def cameras(draw: st.DrawFn, layers: tuple[str, ...] = ("nearest", "linear", "cubic"), **fixed: object) -> TiDyOptics:
    """Cameras without noise in linear light, computed in float64."""
    chosen = {
        "compositing": draw(st.sampled_from(["gather", "scatter", "occlusion"])),
        "border": draw(st.sampled_from(["reflect", "replicate", "circular"])),
        "fidelity": Fidelity.preset("draft").replace(
            window=draw(st.sampled_from([1, 3, 9])),
            layers=draw(st.sampled_from(layers)),
            stray_light=draw(st.sampled_from(["renormalize", "veil", "discard"])),
        ),
        **fixed,
    }
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    masks = PixelwiseMask(draw(st.integers(1, 3)), draw(st.sampled_from([1, 5, 23])), generator=generator)
    return TiDyOptics(masks, sensor=None, color_space="linear", **chosen)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Images in [0, 1] with black and white areas, and depths of a few values or many, in float64."""
    height, width = draw(st.integers(8, 20)), draw(st.integers(8, 20))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    image = (3 * torch.rand(1, 3, height, width, generator=generator, dtype=torch.float64) - 1).clamp(0, 1)
    nearness = 3.3 * torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    steps = draw(st.sampled_from([0, 1, 2, 50]))
    nearness = (nearness / 3.3 * steps).round() / max(steps, 1) * 3.3
    return image, nearness.reciprocal()  # 0 steps: all at infinity


def taken(optics: TiDyOptics, *scene: Tensor, **noise: object) -> Tensor:
    with torch.no_grad():
        return optics(*scene, **noise)


class TestLaws(BaseTester):
    @FEW
    @given(cameras(POSITIVE), scenes())
    def test_feature_no_light_is_created(self, optics, scene):
        captured = taken(optics, *scene)
        assert captured.min() >= -TOLERANCE
        if optics.compositing != "scatter":  # which may focus light of several pixels onto one
            assert captured.max() <= scene[0].max() + TOLERANCE

    @FEW
    @given(cameras(), scenes(), st.floats(0, 1))
    def test_feature_a_uniform_scene_stays_uniform(self, optics, scene, level):
        image = torch.full_like(scene[0], level)
        depth = torch.full_like(scene[1], float(scene[1].flatten()[0]))
        expected = image
        if optics.fidelity.stray_light == "discard":
            expected = taken(optics, torch.ones_like(image), depth)[..., :1, :1] * level
        # Occlusion divides by the share of a PSF in its window plus 1e-6, so that nothing is divided by zero.
        share = float(optics.psf_bank().psfs.detach().sum((2, 3)).min().clamp(1e-6, 1))
        tolerance = 1.1e-6 / share if optics.compositing == "occlusion" else TOLERANCE
        self.assert_close(taken(optics, image, depth), expected.expand_as(image), atol=tolerance, rtol=0)

    @FEW
    @given(cameras(), scenes(), st.floats(0, 3))
    def test_feature_linear_in_the_image(self, optics, scene, factor):
        image, depth = scene
        other = image.flip(-1)
        together = taken(optics, image + factor * other, depth)
        apart = taken(optics, image, depth) + factor * taken(optics, other, depth)
        self.assert_close(together, apart, atol=4 * TOLERANCE, rtol=0)

    @FEW
    @given(cameras(POSITIVE), scenes(), st.floats(1, 100))
    def test_feature_more_light_is_nowhere_less(self, optics, scene, factor):
        image, depth = scene
        assert bool((taken(optics, factor * image, depth) >= taken(optics, image, depth) - 100 * TOLERANCE).all())

    @FEW
    @given(cameras(border="circular"), scenes(), st.integers(-9, 9), st.integers(-9, 9))
    def test_feature_a_shifted_scene_gives_the_shifted_capture(self, optics, scene, down, across):
        moved = [part.roll((down, across), (-2, -1)) for part in scene]
        expected = taken(optics, *scene).roll((down, across), (-2, -1))
        self.assert_close(taken(optics, *moved), expected, atol=TOLERANCE, rtol=0)

    @FEW
    @given(cameras(), scenes(), st.integers(-1000, 1000))
    def test_feature_whole_waves_over_the_whole_mask_change_nothing(self, optics, scene, turns):
        before = taken(optics.double(), *scene)
        with torch.no_grad():
            optics.masks.phase += 2 * math.pi * turns
        self.assert_close(taken(optics, *scene), before, atol=1e-9, rtol=0)
