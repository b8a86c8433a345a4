from __future__ import annotations

import dataclasses
import math
import runpy

import pytest
import torch

from kornia_tidy import PixelwiseMask, SensorNoise, ThinLensCamera, TiDyOptics
from kornia_tidy.cli.app.capture import known_system, own_camera, take_picture
from kornia_tidy.cli.app.script import as_python
from kornia_tidy.cli.app.settings import CAMERAS, Settings
from kornia_tidy.data import Scene, dead_leaves, read_depth, read_image, write_depth, write_image
from kornia_tidy.reconstruction.pretrained import PRETRAINED
from kornia_tidy.reconstruction.tasks import metres
from tests.base import BaseTester

SMALL = {"side": 96}
FILES = {"scene": "files", "image_file": "photo.png", "depth_file": "depth.png", "depth_scale": 0.001}
EVERY_KIND = {
    "trained": {},
    "trained for the image": {"camera": "edof-5", "compositing": "scatter", "noise": 0.01},
    "a plain lens": {"camera": "edof-flat", "stretch": False, "near": 0.4, "far": 5.0},
    "published": {"camera": "phasecam3d", "scene": "photographic leaves", "seed": 3},
    "published, other compositing": {"camera": "tidy-5", "compositing": "scatter", "mask_seed": 7},
    "own": {"camera": "own", "start": "noise", "masks": 7, "scene": "photographic leaves", "noise": 0.0},
    "own, flat, occlusion": {"camera": "own", "start": "flat", "compositing": "occlusion", "f_number": 12.0},
    "own, fitted": {"camera": "own", "start": "focal sweep", "masks": 3, "fit": True, "far": 3.0},
    "own, behind a lens": {"camera": "own", "start": "noise", "masks": 2, "lens": "double-gauss-50mm", "place": 0.5},
    "files": {**FILES, "noise_seed": 5},
    "files, larger": {**FILES, "stretch": False, "camera": "edof-5"},
    "files, own": {**FILES, "camera": "own", "pixel_pitch": 4e-6, "focus_distance": 1.0},
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder in which the test runs, with a photo and its depth map of 120 x 96 pixels."""
    monkeypatch.chdir(tmp_path)
    image, depth = dead_leaves(96, 120, depth_range=(0.6, 3.0), num_leaves=60, seed=2)
    write_image("photo.png", image)
    write_depth("depth.png", depth, scale=0.001)
    return tmp_path


class TestTakePicture(BaseTester):
    def test_feature_the_network_restores_and_tells_depth_better_than_nothing(self):
        result = take_picture(Settings(side=192))
        scores = result.scores()
        assert scores["image_psnr"] > scores["capture_psnr"] + 1
        assert scores["depth_rmse"] < 0.8 * scores["mean_rmse"]

    def test_feature_the_same_by_the_library_alone(self):
        """Written out for the own camera: f/20 is an aperture of 40 mm / 20."""
        settings = Settings(camera="own", start="noise", masks=2, focal_length=0.04, f_number=20, noise=0.01, **SMALL)
        image, depth = dead_leaves(72, 96, depth_range=(0.3, 10.0), num_leaves=27, seed=0)
        masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(0))
        far, near = (float(end) for end in (depth.amax(), depth.amin()))
        camera = ThinLensCamera(0.04, 0.002, 0.595, depth_range=(near, far))
        optics = TiDyOptics(masks, camera, sensor=SensorNoise(0.01))
        with torch.no_grad():
            expected = optics(image, depth, generator=torch.Generator().manual_seed(0))
        assert torch.equal(take_picture(settings).capture, expected)

    @pytest.mark.parametrize("camera", ["joint-uncertain", "ikoma2021"])
    def test_feature_stretched_depths_fill_the_range_of_the_camera(self, camera):
        result = take_picture(Settings(camera=camera, **SMALL))
        assert result.clamped == 0
        near, far = result.camera.depth_range
        assert float(result.scene.depth.amax()) == pytest.approx(far, rel=1e-6)
        assert near <= float(result.scene.depth.amin()) < 1.3 * near

    def test_feature_stages_are_told_in_order(self):
        told = []
        take_picture(Settings(camera="own", **SMALL), lambda share, stage: told.append((share, stage)))
        assert [stage for _, stage in told] == ["scene", "camera", "PSFs and capture", "reconstruction"]
        assert sorted(told) == told

    @pytest.mark.parametrize("camera", [name for name in CAMERAS if name not in PRETRAINED and name != "own"])
    def test_smoke_every_published_system_has_a_lens_in_metres(self, camera):
        optics, system = known_system(camera, "gather", 0.01, 0)
        assert system is None
        assert isinstance(optics.camera, ThinLensCamera)
        assert optics.compositing == "gather"


class TestOwnCamera(BaseTester):
    def scene(self, near, far):
        depth = torch.linspace(1 / near, 1 / far, 80).reciprocal().expand(1, 60, 80)
        return Scene(torch.rand(3, 60, 80), depth, torch.ones_like(depth, dtype=torch.bool))

    def test_feature_the_range_is_that_of_the_scene(self):
        camera = own_camera(Settings(camera="own"), self.scene(0.4, 2.0))
        self.assert_close(torch.tensor(camera.depth_range), torch.tensor([0.4, 2.0]))

    def test_feature_a_scene_at_one_depth(self):
        image, depth = torch.rand(3, 8, 8), torch.full((1, 8, 8), 0.7)
        near, far = own_camera(Settings(camera="own"), Scene(image, depth, depth > 0)).depth_range
        assert near < 0.7 < far

    def test_feature_a_fit_gives_20_radians_at_both_ends(self):
        camera = own_camera(Settings(camera="own", fit=True), self.scene(0.5, math.inf))
        self.assert_close(torch.tensor(camera.defocus_range), torch.tensor([-20.0, 20.0]))

    def test_exception_blur_wider_than_the_psfs(self):
        """By geometry: aperture 10 mm, image distance 54.6 mm, 1.68 dioptres out of focus, pixels of 8 um: 115 px."""
        with pytest.raises(ValueError, match=r"at f/5 a point at inf m is 115 pixels wide, and 65 are allowed"):
            own_camera(Settings(camera="own", f_number=5.0), self.scene(0.5, math.inf))


@pytest.mark.filterwarnings("ignore:.*beyond the camera's range:UserWarning")
class TestScript(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("kind", EVERY_KIND)
    def test_feature_it_runs_and_gives_the_same_capture(self, kind, folder):
        result = take_picture(Settings(**{**SMALL, **EVERY_KIND[kind]}))
        (folder / "capture.py").write_text(as_python(result.settings), encoding="utf-8")
        found = runpy.run_path("capture.py")
        assert torch.equal(found["result"].capture, result.capture)
        assert torch.equal(found["result"].image, result.image)
        assert float((read_image("capture.png") - result.capture).abs().max()) <= 0.5 / 255 + 1e-6
        if result.estimate is not None:
            assert torch.equal(read_depth("depth.npy").depth, metres(result.camera, result.estimate))
        assert (folder / "depth.npy").exists() == (result.estimate is not None)

    def test_feature_it_is_as_short_as_a_user_would_write_it(self):
        lines = as_python(Settings(**SMALL)).splitlines()
        assert len(lines) <= 25
        assert max(map(len, lines)) <= 120

    def test_feature_odd_names_of_files(self, folder):
        name = "a \"quoted\" ünïcode 深度 back\\slash 'x'.png"
        (folder / "photo.png").rename(folder / name)
        result = take_picture(Settings(**{**SMALL, **FILES, "camera": "own", "image_file": name}))
        (folder / "capture.py").write_text(as_python(result.settings), encoding="utf-8")
        assert torch.equal(runpy.run_path("capture.py")["result"].capture, result.capture)


class TestBehindALens(BaseTester):
    def test_exception_depths_that_the_lens_is_not_known_for(self):
        settings = Settings(camera="own", lens="single-50mm", near=0.45, far=0.6, f_number=8.0, focus_distance=1.5)
        with pytest.raises(ValueError, match=r"the lens 'single-50mm' is asked for a defocus of .*: choose another"):
            take_picture(settings)


class TestResult(BaseTester):
    def test_feature_only_known_depths_count(self, folder):
        result = take_picture(Settings(**SMALL))
        truth, estimate = result.inverse_depth, torch.zeros_like(result.inverse_depth)
        known = truth < truth.quantile(0.5)
        part = dataclasses.replace(result, estimate=estimate, scene=result.scene._replace(valid=known))
        assert part.scores()["depth_rmse"] == pytest.approx(float(truth[known].square().mean().sqrt()), rel=1e-5)
        assert part.scores()["mean_rmse"] == pytest.approx(float(truth[known].std(correction=0)), rel=1e-4)
