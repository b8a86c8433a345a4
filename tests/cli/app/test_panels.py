"""Pictures of the page: their content and order, and the settings that must change them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from kornia_tidy.cli.app.answers import draw
from kornia_tidy.cli.app.capture import own_camera, take_picture
from kornia_tidy.cli.app.legends import legends
from kornia_tidy.cli.app.scenes import read_files
from kornia_tidy.cli.app.script import as_python
from kornia_tidy.cli.app.settings import Settings
from kornia_tidy.data import write_image
from kornia_tidy.reconstruction.tasks import stretched
from tests.base import BaseTester

matplotlib = pytest.importorskip("matplotlib", reason="depth maps and masks are drawn with matplotlib")

SMALL = {"side": 96}


@pytest.fixture(scope="module")
def result():
    """Three random masks, whose PSFs have no symmetry, over a range of defocus without symmetry."""
    return take_picture(Settings(camera="own", start="noise", masks=3, near=0.4, far=2.0, **SMALL))


class TestDraw(BaseTester):
    def test_feature_each_picture_is_what_its_name_says(self, result):
        def grey(value, channels=3):
            return torch.full((channels, 72, 96), value)

        known = dataclasses.replace(
            result,
            scene=result.scene._replace(image=grey(0.6)),
            capture=grey(0.2),
            image=grey(0.4),
            inverse_depth=grey(0.0, 1),
            estimate=grey(1.0, 1),
        )
        found = draw(known)
        assert [found[name].mean() for name in ("scene", "capture", "image")] == [153, 51, 102]
        assert found["depth"][:300].mean() < 20
        assert found["estimate"][:300].mean() > 200


class TestFiles(BaseTester):
    @pytest.fixture
    def files(self, tmp_path, monkeypatch):
        """A photo, and a depth map with a fifth of holes and fewer than half a percent of far pixels."""
        monkeypatch.chdir(tmp_path)
        write_image("photo.png", torch.rand(3, 72, 96))
        depth = np.tile(np.linspace(0.5, 2.0, 96, dtype=np.float32), (72, 1))
        depth[:, 76:] = np.nan  # filled from the nearest known ones, many of them from those at 50 m
        depth[:20, 90] = 50.0
        np.save("depth.npy", depth)
        return {"scene": "files", "image_file": "photo.png", "depth_file": "depth.npy", **SMALL}

    def test_feature_depths_that_are_not_known_do_not_stretch_the_others(self, files):
        result = take_picture(Settings(**files))
        read = read_files("photo.png", "depth.npy", 1.0, 96)
        expected = stretched(read.depth, read.valid, result.camera)
        assert torch.equal(result.scene.depth, expected)
        assert not torch.equal(stretched(read.depth, torch.ones_like(read.valid), result.camera), expected)

    def test_feature_a_file_of_the_same_name_is_read_again(self, files):
        before = take_picture(Settings(**files)).capture
        write_image("photo.png", torch.rand(3, 72, 96))
        assert not torch.equal(take_picture(Settings(**files)).capture, before)

    def test_feature_the_script_has_the_unit_to_the_last_digit(self, files):
        assert f"depth_scale={1 / 256 * 100!r}" in as_python(Settings(**files, depth_scale=1 / 256 * 100))

    def test_feature_a_fitted_lens_keeps_the_pixels_of_the_settings(self, files):
        read = read_files("photo.png", "depth.npy", 1.0, 96)
        camera = own_camera(Settings(**files, camera="own", fit=True, pixel_pitch=5e-6, focal_length=0.035), read)
        assert (camera.pixel_pitch, camera.focal_length) == (5e-6, 0.035)


class TestWords(BaseTester):
    def test_feature_the_error_of_one_depth_everywhere_stands_beside_that_of_the_estimate(self, result):
        truth = torch.linspace(0, 1, 96).expand(1, 72, 96)
        known = dataclasses.replace(result, inverse_depth=truth, estimate=truth + 0.1)
        told = legends(known)["estimate"]  # a ramp of 96 steps has a deviation of 0.29; beyond 1 the error is less
        assert "RMSE 0.10 of the range" in told
        assert "would have 0.29" in told

    def test_feature_the_start_of_masks_of_ones_own_does_not_name_a_trained_system(self):
        trained = take_picture(Settings(start="flat", **SMALL))
        assert "5 masks, in turn" in legends(trained)["capture"]
