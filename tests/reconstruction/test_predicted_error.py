"""Wiener kernels that truncation spoils give way to those for more noise."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.data import sample_scene
from kornia_tidy.reconstruction import ClosedForm
from kornia_tidy.reconstruction.closed_form import NODES, WIENER_NOISES
from kornia_tidy.reconstruction.predicted_error import best_wiener_kernels
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from tests.base import BaseTester

NOISE = 0.01


def random_camera(radians):
    """A camera with masks of random phase."""
    optics = TiDyOptics(PixelwiseMask(2), sensor=SensorNoise(NOISE))
    torch.nn.init.uniform_(dict(optics.masks.named_parameters())["phase"], -radians, radians)
    return optics


def bank(optics):
    return optics.psf_bank(3, defocus=torch.linspace(*optics.camera.defocus_range, NODES).tolist())


class TestBestWienerKernels(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("name", ["edof-5", "edof-designed"])
    def test_feature_trained_systems_have_the_kernels_of_their_noises(self, name):
        form = load_pretrained(name).head.closed_form
        assert torch.equal(form.kernels, wiener_kernels(form.psfs, WIENER_NOISES))

    @pytest.mark.parametrize("bilateral", [False, True])
    def test_feature_behind_random_masks_a_restoration_is_nearer_to_the_scene_than_the_capture(self, bilateral):
        optics, scene = random_camera(20.0), sample_scene(height=160)
        capture = optics(scene.image[None], scene.depth[None]).detach()
        form = ClosedForm(inverse="wiener", bilateral=bilateral)
        form.set_psfs(bank(optics))

        def error(image):
            return float((image - scene.image)[..., 24:-24, 24:-24].square().mean())

        assert error(form(capture, NOISE).image.detach()) < error(capture)

    def test_exception_psfs_of_even_sides(self):
        with pytest.raises(ValueError, match=r"psfs must have shape \(D, C, P, P\) with P odd, got \(2, 3, 4, 4\)"):
            best_wiener_kernels(torch.ones(2, 3, 4, 4), WIENER_NOISES)

    def test_gradcheck(self):
        psfs = torch.rand(2, 1, 3, 3, dtype=torch.float64, requires_grad=True)
        self.gradcheck(lambda psfs: best_wiener_kernels(psfs, (0.05, 0.1)), (psfs,))
