"""Properties of masks, exposures and sensors that hold for any scene, heights to 1 mm, in float64."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kornia_tidy import DefocusRange, DwellTimes, Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from tests.base import BaseTester
from tests.rounding import gamma

COMPOSITINGS = ("gather", "scatter", "occlusion")
EXACT = 1e-11  # transforms of some 40 px in float64, whose largest number is 1
SMALL = Fidelity(window=9, layer_spacing=5.0, double=True)
HEIGHT, WIDTH = 13, 17
SEEDS = st.integers(0, 10_000)
MASKS = st.integers(1, 4)
HEIGHTS = st.sampled_from([0.0, 1e-9, 1.06e-6, 1e-4, 1e-3])  # metres; the last is 943 waves
STRAY_LIGHT = st.sampled_from(["renormalize", "veil", "discard"])
FEW = settings(max_examples=12)


def heights(count: int, highest: float, seed: int) -> Tensor:
    """Return random heights in metres, (K, 7, 7)."""
    return highest * torch.rand(count, 7, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def optics(initial: Tensor, **options: object) -> TiDyOptics:
    """Return a camera without noise in linear light, in float64."""
    usual = {"sensor": None, "color_space": "linear", "fidelity": SMALL, "camera": DefocusRange(-12.0, 15.0)}
    return TiDyOptics(PixelwiseMask(initial=initial), **{**usual, **options}).double()


def scene(seed: int) -> tuple[Tensor, Tensor]:
    """Return a random image and random disparity, of which a third is one plane."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    disparity = torch.rand(1, 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    disparity[..., : WIDTH // 3] = 1.0
    return image, disparity


@torch.no_grad()
def capture(camera: TiDyOptics, image: Tensor, disparity: Tensor) -> Tensor:
    return camera(image, disparity)


class TestProperties(BaseTester):
    @given(count=MASKS, highest=HEIGHTS, seed=SEEDS, psi=st.floats(-200, 200), window=st.sampled_from([1, 9, 41]))
    @FEW
    def test_property_a_psf_holds_no_more_light_than_enters(self, count, highest, seed, psi, window):
        """In float32, too. What a sensor pixel gets is integrated to its tolerance, and rounded."""
        camera = optics(heights(count, highest, seed), fidelity=SMALL.replace(window=window, stray_light="discard"))
        for dtype in (torch.float32, torch.float64):
            bank = camera.psf_bank(dtype=dtype, defocus=[psi])
            assert float(bank.psfs.detach().min()) >= 0
            assert float(bank.energy.detach().max()) <= 1 + camera.fidelity.pixel_tolerance + gamma(4000, dtype)

    @given(count=MASKS, highest=HEIGHTS, seed=SEEDS, stray_light=STRAY_LIGHT)
    @FEW
    def test_property_scatter_creates_no_light(self, count, highest, seed, stray_light):
        fidelity = SMALL.replace(stray_light=stray_light)
        camera = optics(heights(count, highest, seed), compositing="scatter", border="circular", fidelity=fidelity)
        image, disparity = scene(seed)
        before, after = image.sum((2, 3)), capture(camera, image, disparity).sum((2, 3))
        assert bool((after <= before * (1 + fidelity.pixel_tolerance) + EXACT).all())

    @pytest.mark.parametrize("color_space", ["linear", "srgb"])
    @given(highest=HEIGHTS, seed=SEEDS, factor=st.floats(1, 3), bits=st.sampled_from([None, 1, 8]))
    @FEW
    def test_property_longer_exposures_are_nowhere_darker(self, color_space, highest, seed, factor, bits):
        sensor = SensorNoise(0.0, bits=bits)
        camera = optics(heights(2, highest, seed), color_space=color_space, sensor=sensor)
        image, disparity = scene(seed)
        image = image / 3
        shorter, longer = (capture(camera, part, disparity) for part in (image, factor * image))
        # Rounding may take a value across the threshold of the converter only if the exposures are equal.
        assert float((longer - shorter).min()) >= (-EXACT if bits is None or factor > 1 + 1e-9 else -1.0)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @given(
        times=st.lists(st.floats(0, 1e3), min_size=1, max_size=6).filter(lambda times: sum(times) > 1e-3),
        highest=HEIGHTS,
        seed=SEEDS,
    )
    @FEW
    def test_property_copies_of_a_mask_are_the_mask(self, compositing, times, highest, seed):
        one = heights(1, highest, seed)
        copies = optics(one.expand(len(times), -1, -1).clone(), modulator=DwellTimes(times), compositing=compositing)
        alone = optics(one, compositing=compositing)
        self.assert_close(*(capture(camera, *scene(seed)) for camera in (copies, alone)), rtol=0, atol=1e-9)

    @given(highest=HEIGHTS, seed=SEEDS, turns=st.integers(-1000, 1000))
    @FEW
    def test_property_whole_waves_over_the_whole_mask_change_nothing(self, highest, seed, turns):
        one = heights(1, highest, seed)
        cameras = [optics(one), optics(one)]
        with torch.no_grad():
            cameras[1].masks.phase += 2 * math.pi * turns
        self.assert_close(*(capture(camera, *scene(seed)) for camera in cameras), rtol=0, atol=1e-9)
