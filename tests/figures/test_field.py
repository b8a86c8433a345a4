from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import DefocusRange, NoMask, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.figures import draw_lens
from kornia_tidy.figures.field import airy_radius
from kornia_tidy.figures.field_measures import depths_around_focus, heights_to_corner, measures_over_field
from kornia_tidy.optics import Lens, ThinLensCamera
from tests.base import BaseTester
from tests.figures.texts import check_texts

PITCH = 8e-6


def of_lens(**aberrations: float) -> TiDyOptics:
    """A camera without masks behind a thin lens of f/17.6 with Seidel aberrations, in one colour."""
    lens = Lens.from_seidel(50e-3, 17.6, 0.595, 6e-3, **aberrations)
    spectrum = Spectrum.monochrome()
    return TiDyOptics(NoMask(), lens.camera(PITCH), lens=lens, spectrum=spectrum, fidelity="draft")


class TestDrawLens(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("masks", [0, 2])
    def test_feature_no_text_leaves_the_picture_or_covers_another(self, masks):
        shown = PixelwiseMask(masks) if masks else NoMask()
        figure = draw_lens(TiDyOptics(shown, lens="single-50mm", fidelity="draft"), field=3)
        words = [text for axes in figure.axes for text in (axes.title, axes.xaxis.label, axes.yaxis.label)]
        words += [text for part in (figure, *figure.subfigs[0].subfigs) for text in part.texts]
        # Titles, depths, heights, spreads, charts with their axes.
        assert len(check_texts(figure, words)) == 3 + 10 + 3 + 15 + 9
        assert len(figure.axes) == 2 * 3 * 5 + 3

    def test_feature_a_lens_draws_itself_without_masks(self):
        lens = Lens.from_seidel(50e-3, 17.6, 0.595, 5e-3, coma=1.0, wavelengths=(470e-9, 530e-9, 610e-9))
        bare = TiDyOptics(NoMask(23), lens.camera(PITCH), lens=lens)
        drawn, expected = (
            [image.get_array() for axes in figure.axes for image in axes.images]
            for figure in (lens.show(2), draw_lens(bare, 2))
        )
        assert all(np.array_equal(*pair) for pair in zip(drawn, expected, strict=True))

    def test_exception_no_lens(self):
        with pytest.raises(ValueError, match="a lens is drawn of a camera that has one, got none"):
            draw_lens(TiDyOptics(fidelity="draft"))

    def test_exception_no_height(self):
        with pytest.raises(ValueError, match="field must be positive and finite heights, got 0"):
            draw_lens(of_lens(), field=0)


class TestMeasuresOverField(BaseTester):
    def test_feature_an_ideal_lens_is_one_everywhere(self):
        measured = measures_over_field(of_lens(), (0.0, 6e-3), torch.tensor([0.0]))
        self.assert_close(measured.strehl, torch.ones(2, 1, 1).double(), rtol=0, atol=0.02)
        assert float(measured.spread.max()) < 1e-2
        assert measured.depths == ("0.595 m",)

    def test_feature_contrast_of_an_ideal_lens_is_the_closed_form(self):
        """Goodman, 6.3: two circles that overlap, times the pixel's sinc, and what folds at half a cycle per pixel."""
        optics = of_lens().with_fidelity(of_lens().fidelity.replace(window=101, pixel_tolerance=1e-5))
        measured = measures_over_field(optics, (0.0,), torch.tensor([0.0]))
        frequency = np.linspace(0, 0.5, measured.tangential.shape[-1])

        def transfer(frequency: np.ndarray) -> np.ndarray:
            ratio = np.minimum(frequency * airy_radius(optics) / 1.22, 1)  # of the cutoff
            circles = 2 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1 - ratio**2))
            return circles * np.sinc(frequency)

        expected = transfer(frequency) + transfer(1 - frequency)
        for found in (measured.tangential, measured.sagittal):  # the window cuts half a per cent of the light
            assert float(np.abs(found[0, 0, 0].numpy() - expected).max()) < 0.01

    def test_feature_astigmatism_blurs_along_the_field(self):
        """W222 h^2 rho^2 cos^2: rays spread along the field only, and so does the light."""
        measured = measures_over_field(of_lens(astigmatism=3.0), (0.0, 6e-3), torch.tensor([0.0]))
        rays = measured.rays[1][0][0]
        assert float(rays[:, 1].std()) > 20 * float(rays[:, 0].std())
        assert float(measured.tangential[1, 0, 0, 40]) < 0.5 * float(measured.sagittal[1, 0, 0, 40])
        self.assert_close(measured.tangential[0], measured.sagittal[0], rtol=0, atol=1e-4)

    def test_feature_the_table_has_a_line_for_each_height_depth_and_colour(self):
        optics = TiDyOptics(NoMask(), lens="single-50mm", fidelity="draft")
        measured = measures_over_field(optics, (0.0, 6.7e-3), torch.tensor([-20.0, 0.0]))
        heads, *lines = measured.table()
        assert len(lines) == 2 * 2 * 3
        assert heads.split()[:4] == ["height", "depth", "psi,", "rad"]
        assert lines[0].split()[:4] == ["0.00", "mm", "0.595", "m"]
        assert {line.index("nm") for line in lines} == {lines[0].index("nm")}

    def test_exception_no_lens(self):
        with pytest.raises(ValueError, match="need a camera with a lens, got none"):
            measures_over_field(TiDyOptics(fidelity="draft"), (0.0,), torch.tensor([0.0]))

    @pytest.mark.parametrize(("ends", "count"), [((-20.0, 10.0), 5), ((2.0, 10.0), 3), ((0.0, 10.0), 3)])
    def test_feature_depths_hold_focus_and_both_ends(self, ends, count):
        found = depths_around_focus(DefocusRange(*ends)).tolist()
        assert len(found) == count
        assert (found[0], found[-1]) == ends
        assert found == sorted(found)
        assert (0.0 in found) == (ends[0] <= 0)

    def test_feature_heights_end_at_the_corner(self):
        lens = Lens.from_seidel(50e-3, 4.0, 1.0, 8e-3)
        assert heights_to_corner(lens, 5)[1::3] == (2e-3, 8e-3)
        assert heights_to_corner(lens, 1) == (0.0,)

    def test_feature_airy_radius_of_the_default_lens(self):
        camera = ThinLensCamera()
        expected = 1.22 * 530e-9 * float(camera.image_distance) / camera.aperture_diameter / PITCH
        assert airy_radius(TiDyOptics(fidelity="draft")) == pytest.approx(expected, rel=1e-6)
