import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.optics import FUSED_SILICA, NOA61, PDMS, PMMA, cauchy_through, constant_index
from tests.base import BaseTester, shared

FILES = {
    FUSED_SILICA: "main_SiO2_nk_Malitson.yml",
    PMMA: "organic__C5H8O2_n_-_poly_methyl_methacrylate__nk_Beadie.yml",
    PDMS: "organic__C2H6OSi_n_-_polydimethylsiloxane_nk_Schneider-Sylgard184.yml",
    NOA61: "other_optical_adhesives_NOA-61_nk_Norland.yml",
}
MATERIALS = list(FILES)
by_name = pytest.mark.parametrize("material", MATERIALS, ids=lambda material: material.name)


class TestMaterial(BaseTester):
    @pytest.mark.parametrize("wavelength", [0.0, -530e-9, math.nan, math.inf])
    def test_exception_a_wavelength_is_that_of_light(self, wavelength):
        with pytest.raises(ValueError, match=f"wavelength must be metres between .*, got {wavelength}"):
            constant_index(1.5).index(wavelength)

    @pytest.mark.parametrize(
        ("material", "allowed"),
        [(FUSED_SILICA, "210 to 3710"), (PMMA, "420 to 1620"), (PDMS, "350 to 700"), (NOA61, "450 to 1550")],
    )
    def test_exception_names_the_published_range(self, material, allowed):
        shortest, longest = material.valid
        for wavelength in (shortest - 1e-9, longest + 1e-9):
            with pytest.raises(ValueError, match=f"{material.name} is published for {allowed} nm, got"):
                material.index(wavelength)

    @by_name
    def test_feature_both_ends_of_the_range_belong_to_it(self, material):
        assert material.index(material.valid[0]) > material.index(material.valid[1]) > 1

    def test_feature_a_rounded_end_belongs_to_the_range(self):
        below = math.nextafter(450e-9, 0)
        assert NOA61.index(below) == pytest.approx(NOA61.index(450e-9), abs=1e-12)

    @pytest.mark.parametrize(
        ("material", "indices"),
        [
            (FUSED_SILICA, (1.46415, 1.46080, 1.45771)),
            (PDMS, (1.43992, 1.43492, 1.43052)),
            (PMMA, (1.49970, 1.49539, 1.49163)),
            (NOA61, (1.57071, 1.56434, 1.55826)),
        ],
    )
    def test_feature_matches_the_published_index_at_470_530_and_610_nm(self, material, indices):
        """Against refractiveindex.info's own values, rounded there to five places."""
        for wavelength, index in zip((470e-9, 530e-9, 610e-9), indices, strict=True):
            assert material.index(wavelength) == pytest.approx(index, abs=5.1e-6)

    def test_feature_the_film_of_joseph_2020_is_another_noa61(self):
        """The disagreement in NOA61's docstring: 1.498 at 530 nm in a thin film, against the maker's 1.564."""
        text = shared("data/materials/other_optical_adhesives_NOA-61_nk_Joseph.yml").read_text(encoding="utf-8")
        rows = [[float(number) for number in row] for row in re.findall(r"^\s+(\d\.\d+) (\d\.\d+)$", text, re.M)]
        nearest = min(rows, key=lambda row: abs(row[0] - 0.53))
        assert nearest[1] == pytest.approx(1.498, abs=5e-4)
        assert NOA61.index(530e-9) - nearest[1] > 0.06

    @by_name
    @given(st.floats(0.0, 0.99), st.floats(0.001, 1.0))
    @settings(max_examples=50)
    def test_property_dispersion_is_normal(self, material, start, step):
        """In transparent dielectrics n decreases with the wavelength over the whole visible range."""
        shortest, longest = max(material.valid[0], 400e-9), min(material.valid[1], 700e-9)
        wavelength = shortest + start * (longest - shortest)
        longer = min(wavelength + step * (longest - shortest), longest)
        assert material.index(wavelength) > material.index(longer) > 1


class TestConstantIndex(BaseTester):
    @pytest.mark.parametrize("index", [1.0, 0.5, -1.5, math.nan, math.inf])
    def test_exception_an_index_is_above_one(self, index):
        with pytest.raises(ValueError, match=f"index must be finite and above 1, got {index}"):
            constant_index(index)

    @given(st.floats(100e-9, 20e-6))
    def test_property_is_the_same_at_every_wavelength(self, wavelength):
        assert constant_index(1.5).index(wavelength) == 1.5


class TestCauchyThrough(BaseTester):
    POINTS = ((450e-9, 1.5763), (530e-9, 1.5643), (650e-9, 1.5559))

    def test_feature_goes_through_what_is_known(self):
        glass = cauchy_through("glass", "here", self.POINTS)
        for wavelength, index in self.POINTS:
            assert glass.index(wavelength) == pytest.approx(index, abs=1e-12)

    def test_feature_finds_a_published_cauchy_equation_again(self):
        """NOA61's equation has three terms, so three of its values determine it."""
        waves = (450e-9, 600e-9, 1550e-9)
        found = cauchy_through("NOA61 again", "NOA61", tuple((w, NOA61.index(w)) for w in waves))
        for um in (0.47, 0.53, 0.7, 1.2):
            assert found.index(um * 1e-6) == pytest.approx(NOA61.index(um * 1e-6), abs=1e-12)

    def test_exception(self):
        for points in (((530e-9, 1.5),), ((530e-9, 1.5), (530e-9, 1.6))):
            with pytest.raises(ValueError, match="indices must be known at two or more different wavelengths"):
                cauchy_through("glass", "here", points)
        with pytest.raises(ValueError, match="published for 450 to 650 nm, got 440 nm"):
            cauchy_through("glass", "here", self.POINTS).index(440e-9)
