"""Stray light against PSFs as large as the scene, whose light is all known, convolved by SciPy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve

from kornia_tidy import Fidelity, PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.optics import SYSTEMS
from kornia_tidy.render import render
from kornia_tidy.render.stray_light import normalised_share, share_within
from tests.base import BaseTester
from tests.render.scenes import brute_share_within

HEIGHT, WIDTH = 40, 56
WHOLE = 2 * WIDTH - 1  # px: a PSF of this window takes light from any pixel of the image to any other
PSI = (0.0, 12.0)
MASKS = ("random", "flat", "tidy-5", "ikoma2021")
CONTINUED = {"reflect": "reflect", "replicate": "edge", "circular": "wrap", "zero": "constant"}  # NumPy's names


@cache
def bank(mask: str, window: int, stray_light: str) -> PSFBank:
    fidelity = Fidelity.preset("reference").replace(window=window, stray_light=stray_light)
    generator = torch.Generator().manual_seed(4)
    if mask in SYSTEMS:
        optics = TiDyOptics.from_preset(mask, generator=generator, fidelity=fidelity, compositing="gather")
        if optics.aperture is not None:  # of amplitudes: light that crosses a hard edge is in no window whole
            optics.aperture = 1.0 * optics.aperture
    else:
        masks = PixelwiseMask(1, initial="flat") if mask == "flat" else PixelwiseMask(1, generator=generator)
        optics = TiDyOptics(masks, fidelity=fidelity)
    with torch.no_grad():
        return optics.psf_bank(channels=1, defocus=PSI)


def scene(name: str) -> tuple[np.ndarray, np.ndarray]:
    """An image and its layers, (H, W) each; white is at one depth."""
    near = np.zeros((HEIGHT, WIDTH))
    near[:, WIDTH // 2 :] = 1
    texture = np.random.default_rng(5).uniform(size=(HEIGHT, WIDTH))
    return {"white": (np.ones_like(near), 0 * near), "half": (near, 0 * near), "two": (texture, near)}[name]


def blurred(plane: np.ndarray, psf: np.ndarray, border: str) -> np.ndarray:
    return fftconvolve(np.pad(plane, len(psf) // 2, mode=CONTINUED[border]), psf, mode="valid")


def truth(image: np.ndarray, layer: np.ndarray, psfs: np.ndarray, compositing: str, border: str) -> np.ndarray:
    """The forward models of the README's papers with PSFs as large as the scene."""
    own = [layer == d for d in range(len(psfs))]
    if compositing == "gather":
        return sum(o * blurred(image, h, border) for o, h in zip(own, psfs, strict=True))
    if compositing == "scatter":
        return sum(blurred(o * image, h, border) for o, h in zip(own, psfs, strict=True))
    coded = np.zeros_like(image)
    for d, h in enumerate(psfs):
        seen = blurred(sum(own[: d + 1]) + 0.0, h, border) + 1e-6
        coded = blurred(own[d] * image, h, border) / seen + (1 - blurred(own[d] + 0.0, h, border) / seen) * coded
    return coded


def rendered(image: np.ndarray, layer: np.ndarray, psfs: PSFBank, compositing: str, border: str) -> np.ndarray:
    psi = torch.tensor(PSI, dtype=torch.float64)[torch.from_numpy(layer).long()]
    light = torch.from_numpy(image)[None, None]
    return render(light, psi[None, None], psfs, compositing, layers="nearest", border=border)[0, 0].numpy()


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).mean()))


class TestReference(BaseTester):
    @pytest.mark.parametrize("name", ["white", "half", "two"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    @pytest.mark.parametrize("mask", MASKS)
    def test_feature_no_light_comes_from_the_dark_around(self, mask, compositing, name):
        """With a window that reaches all of the image there is no more to know: nothing is spread."""
        whole = bank(mask, WHOLE, "veil")
        expected = truth(*scene(name), whole.psfs[:, 0].numpy(), compositing, "zero")
        coded = rendered(*scene(name), whole, compositing, "zero")
        self.assert_close(coded, expected, rtol=0, atol=1e-11)

    @pytest.mark.parametrize("window", [15, 31, 61])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize("mask", MASKS)
    def test_feature_what_stays_of_the_stray_light_is_told_to_a_fifth(self, mask, compositing, window):
        """On white; left out or spread over all, it is wrong by all of itself or by all that is lost."""
        narrow, whole = bank(mask, window, "veil"), bank(mask, WHOLE, "veil").psfs[:, 0].numpy()
        expected = truth(*scene("white"), whole, compositing, "zero")
        error = rms(rendered(*scene("white"), narrow, compositing, "zero") - expected)
        assert error < 0.2 * float(narrow.veil[0, 0])

    @pytest.mark.parametrize("border", ["reflect", "replicate", "circular"])
    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    @pytest.mark.parametrize("mask", MASKS)
    def test_feature_where_the_image_goes_on_only_contrast_is_missed(self, mask, compositing, border):
        """Of the light outside the window, its difference from the mean of the image; of white nothing."""
        narrow, whole = bank(mask, 61, "veil"), bank(mask, WHOLE - 34, "veil")  # as wide as reflect can be here
        for name in ("white", "half"):
            image, layer = scene(name)
            rest = float(whole.veil[0, 0]) * image.mean()
            expected = truth(image, layer, whole.psfs[:, 0].numpy(), compositing, border) + rest
            error = rendered(image, layer, narrow, compositing, border) - expected
            assert np.abs(error).max() <= float(narrow.veil[0, 0]) * np.abs(image - image.mean()).max() + 1e-11


class TestShareWithin(BaseTester):
    @pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 4), (11, 12)])
    @pytest.mark.parametrize("size", [1, 3, 7, 11, 23])
    def test_feature_equals_the_sum_over_pixels(self, shape, size, device):
        expected = brute_share_within(*shape, size // 2)
        self.assert_close(share_within(*shape, size, device).cpu().numpy(), expected, rtol=0, atol=1e-13)

    @pytest.mark.parametrize("size", [1, 3, 9, 31])
    def test_property_it_is_a_share_and_symmetric(self, size):
        share = share_within(12, 17, size)
        assert float(share.min()) >= 0
        assert float(share.max()) < 1
        self.assert_close(share, share.flip((0, 1)), rtol=0, atol=1e-15)
        assert bool((share > 0).any()) == (size < 2 * 17 - 1)

    def test_feature_all_stays_in_an_endless_image(self):
        middle = float(share_within(4001, 4001, 3)[2000, 2000])
        assert middle == pytest.approx(1 - 1.5 / 2000.5)


class TestNormalisedShare(BaseTester):
    def test_feature_only_a_border_of_zeros_changes_it(self):
        veil, psfs = torch.rand(2, 3), torch.rand(2, 3, 5, 5)
        assert normalised_share(veil, psfs, (9, 9), "reflect") is veil
        assert float(normalised_share(veil, psfs, (3, 3), "zero").max()) == 0
        assert bool((normalised_share(veil, psfs, (9, 9), "zero") < veil).all())

    def test_gradcheck(self, device):
        veil, psfs = torch.rand(2, 1, device=device), torch.rand(2, 1, 3, 3, device=device)
        self.gradcheck(lambda v, h: normalised_share(v, h, (6, 7), "zero"), (veil, psfs))
