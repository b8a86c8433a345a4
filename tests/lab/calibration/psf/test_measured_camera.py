"""A measurement as a camera: with the lens of its file it takes, plans and restores captures as any other camera."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from kornia_tidy import SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, measured_camera
from kornia_tidy.reconstruction import ClosedFormHead, LayeredJointHead, NAFNet, Refocused
from kornia_tidy.reconstruction.layered_joint import REFINED_FROM
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.trained import update_psfs
from tests.base import BaseTester
from tests.measured import LENS, measured_psfs

SENSOR = SensorNoise.physical(10500, 2.4)


@pytest.fixture(scope="module")
def psfs():
    return measured_psfs()


@pytest.fixture(scope="module")
def scene():
    image, depth = dead_leaves(96, 128, depth_range=(0.4, 2.5), num_leaves=60, seed=3)
    return image[None], depth[None]


def seeded():
    return torch.Generator().manual_seed(0)


class TestMeasuredCamera(BaseTester):
    def test_feature_a_file_is_a_camera(self, psfs, scene, tmp_path):
        psfs.save(tmp_path / "bank.safetensors")
        optics = measured_camera(tmp_path / "bank.safetensors", sensor=SENSOR)
        wanted = TiDyOptics(camera=LENS, sensor=SENSOR).with_bank(psfs.bank)
        assert optics.camera.extra_repr() == LENS.extra_repr()
        assert torch.equal(optics(*scene, generator=seeded()), wanted(*scene, generator=seeded()))
        assert list(optics.parameters()) == []  # nothing to be learnt

    def test_feature_a_fast_lens_and_a_focus_at_infinity(self, psfs, tmp_path, recwarn):
        """Its PSFs without masks would be hundreds of pixels wide; they are not computed."""
        lens = ThinLensCamera(f_number=1.4, focus_distance=math.inf, depth_range=(0.4, 2.5))
        bank = replace(psfs.bank, defocus=lens.defocus(psfs.distances).float())
        replace(psfs, bank=bank, camera=lens).save(tmp_path / "bank.safetensors")
        optics = measured_camera(tmp_path / "bank.safetensors")
        assert math.isinf(optics.camera.focus_distance)
        assert optics.camera.depth_range == (0.4, 2.5)
        assert optics.window == psfs.bank.window
        assert not recwarn.list

    @pytest.mark.parametrize("inverse", ["tikhonov", "wiener"])
    def test_feature_the_closed_form_restores_its_captures_without_training(self, psfs, scene, inverse):
        optics, head = measured_camera(psfs, sensor=SENSOR), ClosedFormHead(inverse=inverse)
        update_psfs(head, optics)
        capture = optics(*scene, generator=seeded())
        assert float(psnr(head(capture), scene[0])) > float(psnr(capture, scene[0])) + 3
        dark, full = SENSOR.std(torch.tensor([0.0, 1.0])).square().tolist()
        self.assert_close(head.closed_form.noise_model, torch.tensor([dark, full - dark]))

    @pytest.mark.parametrize("channels", [1, 3])
    def test_feature_every_network_that_deconvolves_is_told(self, channels, scene):
        """Grey PSFs are those of all colours; one channel of three is green."""
        optics = measured_camera(measured_psfs(channels))
        heads = {
            "likelihood": ClosedFormHead(layers=4, likelihood=True),
            "refocused": Refocused(NAFNet(6, 3, width=2), layers=3),
            "layers": LayeredJointHead(NAFNet(9, 4, width=2), NAFNet(REFINED_FROM, 3, width=2), 3),
        }
        with torch.no_grad():
            for head in heads.values():
                update_psfs(head, optics)
                assert head.eval()(scene[0]).isfinite().all()

    def test_feature_one_distance_is_a_camera_too(self):
        optics = measured_camera(measured_psfs(distances=(0.8,)))
        near, far = optics.camera.depth_range
        assert near < 0.8 < far

    def test_exception_a_file_without_its_lens(self, psfs, tmp_path):
        path = tmp_path / "bank.safetensors"
        replace(psfs, camera=None).save(path)
        assert MeasuredPSFs.load(path).camera is None
        with pytest.raises(ValueError, match="come without the lens"):
            measured_camera(path)

    @pytest.mark.parametrize(
        ("lens", "sentence"),
        [
            ('{"focal_length": 0.05}', "its lens must be given by focal_length, aperture_diameter"),
            ("[]", "its lens must be given by"),
            (
                '{"focal_length": 0.05, "aperture_diameter": 0.01, "focus_distance": 0.595, "pixel_pitch": 8e-06}',
                "the defocus of its PSFs is not that of its lens",
            ),
            ('{"focal_length": "x", "aperture_diameter": 1, "focus_distance": 1, "pixel_pitch": 1}', "focal_length"),
        ],
    )
    def test_exception_a_damaged_lens(self, psfs, tmp_path, lens, sentence):
        path = tmp_path / "bank.safetensors"
        psfs.save(path)
        with safe_open(path, "pt") as file:
            notes = file.metadata()
        save_file(load_file(path), path, {**notes, "camera": lens})
        with pytest.raises(ValueError, match=sentence):
            measured_camera(path)
