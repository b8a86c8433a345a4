from __future__ import annotations

import pytest
import torch

from kornia_tidy import ThinLensCamera
from kornia_tidy.data import Scene
from kornia_tidy.design import compared_cameras
from kornia_tidy.design.compared_cameras import photograph, shipped_cameras, stopped_down
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, build_optics, update_psfs
from tests.base import BaseTester

SMALL = {"head": "plain", "width": 4, "window": 23, "fidelity": "draft"}
SHIPPED = {
    "one": SystemSettings(masks=1, **SMALL),
    "two": SystemSettings(masks=2, f_number=29.0, closed_form=True, **SMALL),
    "lens": SystemSettings(masks=1, start="flat", f_number=48.0, closed_form=True, **SMALL),
    "fresnel": SystemSettings(masks=0, **SMALL),
    "unsure": SystemSettings(task="joint", masks=1, depth_classes=4, refocus=2, **SMALL),
}


@pytest.fixture(autouse=True)
def shipped(monkeypatch):
    def load(name):
        torch.manual_seed(0)
        optics, head = build_optics(SHIPPED[name]), build_head(SHIPPED[name])
        with torch.no_grad():
            update_psfs(head, optics)
        return TrainedSystem(optics.eval(), head.eval(), SHIPPED[name], 0)

    monkeypatch.setattr(compared_cameras, "PRETRAINED", tuple(SHIPPED))
    monkeypatch.setattr(compared_cameras, "pretrained_settings", SHIPPED.__getitem__)
    monkeypatch.setattr(compared_cameras, "load_pretrained", load)


@pytest.fixture
def scene():
    torch.manual_seed(1)
    coarse = torch.nn.functional.interpolate(torch.rand(1, 3, 10, 10), (72, 80), mode="bicubic")[0].clamp(0, 1)
    return Scene(coarse, torch.linspace(0.3, 3, 72 * 80).view(1, 72, 80), torch.ones(1, 72, 80).bool())


class TestShippedCameras(BaseTester):
    def test_feature_the_most_masks_of_each_task_and_the_lens_alone(self):
        cameras = shipped_cameras(10_000)
        assert {kind: camera.settings for kind, camera in cameras.items()} == {
            "coded": SHIPPED["two"], "flat": SHIPPED["lens"], "joint": SHIPPED["unsure"]
        }  # fmt: skip

    def test_feature_the_exposure_time_is_the_same(self):
        wells = {kind: camera.optics.sensor.full_well for kind, camera in shipped_cameras(10_000).items()}
        assert wells["coded"] == pytest.approx(10_000 * (17.6 / 29) ** 2)
        assert wells["flat"] == pytest.approx(10_000 * (17.6 / 48) ** 2)
        assert stopped_down(ThinLensCamera(), 10_000).optics.sensor.full_well < wells["coded"]

    @pytest.mark.parametrize("kind", ["coded", "flat"])
    def test_feature_an_untrained_network_is_told_the_noise_and_improves_the_capture(self, kind, scene, monkeypatch):
        camera = shipped_cameras(57_000)[kind]
        told = []
        forward = type(camera.head).forward
        monkeypatch.setattr(
            type(camera.head), "forward", lambda self, x, noise=None: (told.append(noise), forward(self, x, noise))[1]
        )
        result = photograph(camera, scene, 0)
        light = camera.optics.decode(result.capture[None])
        self.assert_close(told[0], camera.optics.sensor.std(light))
        assert psnr(result.image[None], scene.image[None]) > psnr(result.capture[None], scene.image[None])

    def test_feature_depth_with_its_uncertainty(self, scene):
        result = photograph(shipped_cameras(57_000)["joint"], scene, 0)
        assert result.inverse_depth.shape == result.deviation.shape == (1, 72, 80)

    def test_feature_the_lens_alone_has_no_network(self, scene):
        result = photograph(stopped_down(ThinLensCamera(), 57_000), scene, 0)
        assert result.image is None
        assert psnr(result.closed_form[None], scene.image[None]) > psnr(result.capture[None], scene.image[None])
