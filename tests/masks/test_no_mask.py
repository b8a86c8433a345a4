"""No mask: against the analytic PSF of a disc, in focus and out of it."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import Fidelity, NoMask, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import circular_aperture
from kornia_tidy.psf import Pupil, exact_psf_bank
from tests.base import BaseTester

ONE_MASK = {"no mask": lambda g: NoMask()}


def plain(masks, **options) -> TiDyOptics:
    options = {"fidelity": Fidelity(window=41, stray_light="discard"), "spectrum": Spectrum.monochrome(), **options}
    return TiDyOptics(masks, sensor=None, **options)


class TestNoMask(BaseTester):
    def test_feature_its_pupil_is_the_disc_and_that_of_flat_pixels_is_none(self):
        """Against a grid five times as fine, whose own edge is a fifth of the error."""
        cells, nodes = 460, [0.0, 8.0, -20.0]
        pupil = Pupil(circular_aperture(cells, 2.3 / cells, edges="area"), 2.3 / cells)
        lens = pupil, Spectrum.monochrome(), [1.0], sorted(nodes)
        step = plain(NoMask()).psf_model.pixel_step
        fine = exact_psf_bank(torch.zeros(1, cells, cells), torch.ones(1), *lens, step, 41, 1e-3).psfs
        found, pixels = (plain(masks).psf_bank(defocus=sorted(nodes)).psfs for masks in (NoMask(), FLAT))
        assert float((found - fine).abs().sum((2, 3)).max()) < 0.01
        assert float((pixels - fine).abs().sum((2, 3)).min()) > 0.04
        assert plain(NoMask()).pupil.light == pytest.approx(math.pi, rel=1e-12)

    def test_feature_the_state_is_empty_and_makes_the_same_camera(self):
        optics, other = plain(NoMask()), plain(NoMask())
        assert set(optics.state_dict()) == {"_extra_state"}
        other.load_state_dict(optics.state_dict())
        assert list(optics.parameters()) == []

    def test_feature_an_aperture_that_is_given_is_taken(self):
        assert plain(NoMask(23), aperture=circular_aperture(23)).pupil.light == plain(FLAT).pupil.light

    def test_feature_a_fast_lens_blurs_by_rays(self):
        lens = ThinLensCamera(f_number=2.8, focus_distance=2.0, pixel_pitch=6e-6)
        assert plain(NoMask(), camera=lens, fidelity="balanced").psf_model.wide_blur is not None

    def test_exception_size(self):
        with pytest.raises(ValueError, match="size must be positive"):
            NoMask(0)


FLAT = PixelwiseMask(1, initial="flat").requires_grad_(requires_grad=False)
