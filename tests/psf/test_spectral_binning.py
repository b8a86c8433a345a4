"""Fewer wavelengths: the light of every channel is kept, slices are the best there are, PSFs hardly change."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy import Fidelity, Spectrum, TiDyOptics
from kornia_tidy.optics import camera_spectrum
from kornia_tidy.psf.spectral_binning import bin_spectrum
from tests.base import BaseTester

MANY = camera_spectrum(samples=31)


@st.composite
def spectra(draw) -> Spectrum:
    count = draw(st.integers(1, 8))
    wavelengths = draw(st.lists(st.floats(400e-9, 700e-9), min_size=count, max_size=count))
    row = st.lists(st.floats(0, 1).map(lambda x: x if x > 0.2 else 0.0), min_size=count, max_size=count)
    weights = draw(st.lists(row.filter(lambda x: sum(x) > 0), min_size=1, max_size=3))
    return Spectrum(tuple(wavelengths), tuple(map(tuple, weights)))


def spread(place: np.ndarray, light: np.ndarray) -> float:
    return float((light * (place - np.average(place, weights=light)) ** 2).sum())


class TestFewerWavelengths(BaseTester):
    def test_smoke(self):
        few = bin_spectrum(MANY, 5)
        assert len(few.wavelengths) == 5
        assert len(few.weights) == 3

    @given(spectra(), st.integers(1, 8))
    def test_property_channels_keep_their_light_and_its_mean_wavelength(self, many, count):
        few = bin_spectrum(many, count)
        assert len(few.wavelengths) <= count
        np.testing.assert_allclose(np.sum(few.weights, 1), np.sum(many.weights, 1), rtol=1e-12)
        shares = np.sum(many.channel_weights, 0), np.sum(few.channel_weights, 0)
        means = [np.dot(share, each.wavelengths) for share, each in zip(shares, (many, few), strict=True)]
        assert means[0] == pytest.approx(means[1], rel=1e-12)

    @given(spectra(), st.integers(1, 8))
    def test_property_no_other_slices_spread_the_light_less(self, many, count):
        """Against all ways to cut."""
        light = np.sum(many.channel_weights, 0)
        order = [i for i in np.argsort(many.wavelengths) if light[i] > 0]
        place, light = np.array(many.wavelengths)[order] * 1e9, light[order]
        if len(many.wavelengths) <= count or len(order) < count:
            return
        few = bin_spectrum(many, count)
        every = [
            sum(spread(place[i:j], light[i:j]) for i, j in pairwise((0, *cuts, len(order))))
            for cuts in combinations(range(1, len(order)), count - 1)
        ]
        # What spreads within slices is what the whole spreads more than their means do.
        own = spread(place, light) - spread(np.array(few.wavelengths) * 1e9, np.sum(few.channel_weights, 0))
        assert own == pytest.approx(min(every), abs=1e-6 * (1 + spread(place, light)))

    def test_feature_a_spectrum_of_no_more_is_returned_as_it_is(self):
        assert bin_spectrum(MANY, 31) is MANY
        assert bin_spectrum(Spectrum.rgb(), 8) == Spectrum.rgb()

    def test_feature_what_no_channel_sees_is_left_out(self):
        many = Spectrum((400e-9, 500e-9, 510e-9, 600e-9), ((0, 1, 1, 0), (0, 0, 0, 1)))
        assert bin_spectrum(many, 3).wavelengths == pytest.approx((500e-9, 510e-9, 600e-9))

    def test_feature_colours_with_spectra_stay_what_they_are(self):
        """A basis is checked where a spectrum is made; grey stays flat."""
        few = bin_spectrum(camera_spectrum(samples=31, reflectance=True), 7)
        np.testing.assert_allclose(np.sum(few.basis, 0), 1, atol=1e-9)
        assert len(few.basis[0]) == 7

    def test_feature_gradients_reach_the_masks(self):
        own = TiDyOptics(sensor=None, spectrum=MANY, fidelity=Fidelity(window=9, wavelengths=2))
        own(torch.rand(3, 24, 24), torch.full((1, 24, 24), 0.5)).square().mean().backward()
        assert float(own.masks.phase.grad.abs().max()) > 0

    @pytest.mark.parametrize("count", [0, -1, 1.5])
    def test_exception_names_the_count(self, count):
        with pytest.raises(ValueError, match=f"wavelengths must be a whole number of at least 1, got {count}"):
            bin_spectrum(MANY, count)

    def test_exception_colours_need_a_wavelength_each(self):
        with pytest.raises(ValueError, match="wavelengths must be a whole number of at least 3, got 2"):
            bin_spectrum(camera_spectrum(samples=7, reflectance=True), 2)
