"""Wide blur: layers, windows and geometric PSFs of fast lenses without a mask."""

import math

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import REFERENCE_WAVELENGTH
from kornia_tidy.optics.aperture import OpenArea
from kornia_tidy.psf import PSFModel, exact_psf_bank
from kornia_tidy.psf.geometric_psf import blur_radius, geometric_psfs
from kornia_tidy.psf.pupil import Pupil, pupil_over
from kornia_tidy.psf.wide_blur import FINE_RADIUS, blurs_widely, wide_blur, window_of
from kornia_tidy.psf.wide_psfs import held_nodes, is_flat
from tests.base import BaseTester

STEP = 1.625e-6  # m; 50 mm f/1.8 focused at 2 m, pixels of 6 um
PUPIL = pupil_over((1, 23, 23), None, 1.0)


def fast_lens(f_number: float = 1.8, focus: float = 2.0) -> ThinLensCamera:
    return ThinLensCamera(50e-3, 50e-3 / f_number, focus, 6e-6)


def exact_psf(radius: float, window: int) -> torch.Tensor:
    nodes = [radius * math.pi * STEP / REFERENCE_WAVELENGTH]
    flat, one = torch.zeros(1, 23, 23, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    return exact_psf_bank(flat, one, PUPIL, Spectrum.monochrome(), [1.0], nodes, STEP, window, 1e-2).psfs[0, 0]


class TestGeometricPSFs(BaseTester):
    @pytest.mark.parametrize("psi", [-300.0, 40.0])
    def test_smoke_all_light_lies_in_the_window(self, psi):
        window = window_of(blur_radius(psi, STEP), STEP, PUPIL.extent)
        psf = geometric_psfs(PUPIL.transmission, PUPIL.cell_pitch, [psi], STEP, window)
        self.assert_close(psf.sum(), torch.tensor(1.0, dtype=torch.float64), rtol=0, atol=1e-12)
        assert float(psf.min()) >= 0

    def test_feature_light_through_a_cell_at_the_edge_is_its_open_area(self):
        """Two cells, one half open: two thirds of the light in the half of the image that is theirs."""
        aperture = torch.tensor([[1.0, 0.5], [1.0, 0.5]], dtype=torch.float64).as_subclass(OpenArea)
        psi = 4 * math.pi * STEP / REFERENCE_WAVELENGTH
        pupil = Pupil(aperture, 1.0)
        psf = geometric_psfs(pupil.transmission, pupil.cell_pitch, [psi], STEP, 11)[0]
        left = float(psf[:, :5].sum() + psf[:, 5].sum() * 2 / 3)  # the middle pixel is half of each
        assert left == pytest.approx(2 / 3, abs=1e-12)

    def test_convention_near_is_upright_and_far_upside_down(self):
        aperture = torch.zeros(3, 3)
        aperture[0, 0] = 1
        near, far = (geometric_psfs(aperture, 0.5, [psi], STEP, 41)[0] for psi in (90.0, -90.0))
        self.assert_close(near, far.flip((0, 1)), rtol=0, atol=1e-12)
        assert float(near[:20, :20].sum()) == pytest.approx(1.0, abs=1e-12)
        exact = exact_psf_bank(
            torch.zeros(1, 3, 3), torch.ones(1), pupil_over((1, 3, 3), aperture, 1.0), Spectrum.monochrome(), [1.0],
            [90.0], STEP, 41, 1e-2,
        ).psfs[0, 0]  # fmt: skip
        assert float(exact[:20, :20].sum()) > 0.9

    def test_feature_it_approaches_the_exact_psf_as_the_disc_grows(self):
        """Images of a straight edge: those of wave optics differ by a width of 1 / sqrt(psi) of the radius."""
        errors = []
        for radius in (5.0, 20.0):
            window = window_of(radius, STEP, PUPIL.extent)
            exact = exact_psf(radius, window)
            psi = radius * math.pi * STEP / REFERENCE_WAVELENGTH
            rays = geometric_psfs(PUPIL.transmission, PUPIL.cell_pitch, [psi], STEP, window)[0]
            edges = ((exact / exact.sum() - rays).sum(0)).cumsum(0)
            errors.append(float(edges.abs().max()))
        assert errors[1] < 0.8 * errors[0] < 0.02


class TestWideBlur(BaseTester):
    def test_feature_every_window_holds_97_percent(self):
        for radius in (0.0, 1.0, 6.0, 30.0):
            window = window_of(radius, STEP, PUPIL.extent)
            assert float(exact_psf(radius, window).sum()) > 0.97

    def test_cardinality_groups_share_their_end_nodes_and_cover_the_range(self):
        blur = wide_blur((-572.0, 300.0), STEP, PUPIL)
        assert blur.nodes[0] == pytest.approx(-572.0)
        assert blur.nodes[-1] == pytest.approx(300.0)
        for one, other in zip(blur.groups, blur.groups[1:], strict=False):
            assert one.nodes[-1] == other.nodes[0]
        for group in blur.groups:
            middle = blur_radius(group.nodes[len(group.nodes) // 2], STEP)
            assert (group.grid == 1) == (middle <= FINE_RADIUS)

    def test_feature_only_the_layers_of_the_scene_count(self):
        blur = wide_blur((-572.0, 572.0), STEP, PUPIL)
        two = torch.tensor([-500.0, 10.0]).view(1, 1, 1, 2)
        assert sum(len(nodes) for _, nodes in held_nodes(blur, two)) == 4
        assert sum(len(nodes) for _, nodes in held_nodes(blur, two.flatten())) > 20  # all between the two

    def test_feature_slow_lenses_and_masks_keep_evenly_spaced_layers(self):
        flat = PixelwiseMask(1, initial="flat")
        assert not blurs_widely((-20.0, 20.0), 2.1e-7)
        assert PSFModel(flat).wide_blur is None
        assert PSFModel(flat, fast_lens(), fidelity="reference").wide_blur is None
        assert PSFModel(flat, fast_lens(), fidelity=Fidelity(wide_blur="waves", window=9)).wide_blur is None
        assert PSFModel(PixelwiseMask(1), fast_lens()).wide_blur is None
        assert is_flat(torch.full((2, 3, 3), 0.5))

    def test_feature_masks_that_are_learnt_leave_it(self):
        optics = TiDyOptics(PixelwiseMask(1, initial="flat"), fast_lens(), sensor=None)
        assert optics.psf_model.wide_blur is not None
        with torch.no_grad():
            optics.masks.phase.uniform_(-1, 1)
        optics.psf_bank(defocus=[0.0])
        assert optics.psf_model.wide_blur is None

    def test_exception_of_an_unknown_choice(self):
        with pytest.raises(ValueError, match="wide_blur must be"):
            Fidelity(wide_blur="beams")
