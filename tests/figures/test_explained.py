from __future__ import annotations

import sys

import pytest
import torch
from matplotlib.figure import Figure

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.figures.explained import HEIGHT, WIDTH, draw_masks_and_psfs, explain
from tests.base import BaseTester
from tests.figures.texts import check_texts

QUICK = Fidelity(window=23, layer_spacing=6.67)


def figure_of(optics, height=64, width=80, channels=3):
    image = torch.rand(channels, height, width)
    depth = torch.linspace(0.3, 3.0, height * width).view(1, height, width)
    return explain(image, depth, optics, image, image)


class TestExplain(BaseTester):
    @pytest.mark.parametrize(("masks", "channels", "height"), [(5, 3, 64), (2, 1, 120), (7, 3, 80)])
    def test_feature_no_text_leaves_the_picture_or_covers_another(self, masks, channels, height):
        figure = figure_of(TiDyOptics(PixelwiseMask(masks), fidelity=QUICK), height=height, channels=channels)
        words = [text for part in (figure, *figure.subfigs, *figure.axes) for text in part.texts]
        assert len(check_texts(figure, [*words, *(axes.title for axes in figure.axes)])) > 15

    @pytest.mark.takes_seconds
    def test_feature_all_five_masks_and_six_rows_of_psfs_are_drawn(self):
        figure = figure_of(TiDyOptics(PixelwiseMask(5), fidelity=QUICK))
        pictures = [image.get_array().shape for axes in figure.axes for image in axes.images]
        assert sum(shape == (23, 23) for shape in pictures) == 5
        assert sum(shape == (23, 23, 3) for shape in pictures) == 6 * 7
        assert sum(shape[:2] == (64, 80) for shape in pictures) == 4
        assert figure.get_size_inches().tolist() == [WIDTH, HEIGHT]

    def test_feature_of_a_longer_mask_the_part_over_the_pupil_is_drawn(self):
        figure = figure_of(TiDyOptics(PixelwiseMask(2, size=(23, 41)), fidelity=QUICK))
        assert sum(image.get_array().shape == (23, 23) for axes in figure.axes for image in axes.images) == 2

    def test_feature_headers_run_from_near_to_infinity(self):
        figure = figure_of(TiDyOptics(PixelwiseMask(2), fidelity=QUICK))
        heads = [text.get_text() for axes in figure.axes for text in axes.texts if "ψ" in text.get_text()]
        assert (heads[0], heads[3], heads[-1]) == ("0.3 m\nψ = +20", "0.59 m\nψ = 0", "∞ m\nψ = -20")

    def test_exception_without_matplotlib_says_what_to_install(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        with pytest.raises(ImportError, match=r"pip install 'kornia-tidy\[plot\]'"):
            figure_of(TiDyOptics(PixelwiseMask(2), fidelity=QUICK))

    def test_exception_camera_without_metres(self):
        with pytest.raises(TypeError, match="got DefocusRange"):
            figure_of(TiDyOptics(PixelwiseMask(2), camera=DefocusRange(), fidelity=QUICK))


class TestMasksAndPSFs(BaseTester):
    def test_convention_pictures_lie_as_masks_and_psfs_do_and_each_row_is_one_mask(self):
        """Against the phase and the PSFs of each mask alone; nearest first, the average in the last row."""
        torch.manual_seed(0)
        optics = TiDyOptics(PixelwiseMask(2), fidelity=QUICK)
        figure = Figure()
        draw_masks_and_psfs(figure, optics, optics.camera)
        (axes,) = figure.axes
        pictures = {tuple(image.get_extent()[::3]): image.get_array() for image in axes.images}
        for row, camera in enumerate([optics.through_state(0), optics.through_state(1), optics]):
            (psf,) = camera.psf_bank(defocus=[optics.camera.defocus_range[1]]).psfs.detach()
            drawn = torch.from_numpy(pictures[1.2, row]).movedim(-1, 0)
            self.assert_close(drawn, (psf / psf.max()).sqrt(), rtol=0, atol=1e-5)
        phase = optics.masks.phase[1].detach().remainder(2 * torch.pi)
        shown = torch.from_numpy(pictures[0.0, 1].filled(torch.nan))
        assert int(shown.isnan().sum()) == 23 * 23 - 317
        self.assert_close(shown.nan_to_num(0), phase.where(~shown.isnan(), 0.0))

    def test_feature_one_mask_has_one_row(self):
        optics, figure = TiDyOptics(PixelwiseMask(1), fidelity=QUICK), Figure()
        draw_masks_and_psfs(figure, optics, optics.camera)
        assert len(figure.axes[0].images) == 1 + 7

    def test_feature_of_measured_psfs_the_average_alone_is_drawn(self):
        optics, figure = TiDyOptics(PixelwiseMask(2), fidelity=QUICK), Figure()
        draw_masks_and_psfs(figure, optics.with_bank(optics.psf_bank()), optics.camera)
        assert len(figure.axes[0].images) == 7
