"""Pictures of the page: their content and order, and the settings that must change them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from kornia_tidy.cli.app import pictures
from kornia_tidy.cli.app.answers import draw
from kornia_tidy.cli.app.capture import own_camera, take_picture
from kornia_tidy.cli.app.legends import legends
from kornia_tidy.cli.app.pictures import CELL, COLUMNS, GAP, HEAD, LEFT, MASK_SPACE, TITLE, mask_colors, psf_cell
from kornia_tidy.cli.app.scenes import read_files
from kornia_tidy.cli.app.script import as_python
from kornia_tidy.cli.app.settings import Settings
from kornia_tidy.data import write_image
from kornia_tidy.figures.style import PHASE_COLORS
from kornia_tidy.reconstruction.tasks import stretched
from tests.base import BaseTester

matplotlib = pytest.importorskip("matplotlib", reason="depth maps and masks are drawn with matplotlib")

SMALL = {"side": 96}


@pytest.fixture(scope="module")
def result():
    """Three random masks, whose PSFs have no symmetry, over a range of defocus without symmetry."""
    return take_picture(Settings(camera="own", start="noise", masks=3, near=0.4, far=2.0, **SMALL))


@pytest.fixture(scope="module")
def panel(result):
    return pictures.masks_and_psfs(result)


def cell(panel, row, column):
    """Return a cell of the panel in [0, 1]; column -1 holds the masks."""
    y = TITLE + HEAD + row * (CELL + GAP)
    x = LEFT if column < 0 else LEFT + CELL + MASK_SPACE + column * (CELL + GAP)
    return panel[y : y + CELL, x : x + CELL] / 255


class TestMasksAndPSFs(BaseTester):
    @pytest.mark.parametrize("column", range(COLUMNS))
    def test_feature_each_column_is_one_depth_from_near_to_far(self, result, panel, column):
        """The PSFs of each mask alone, and of all of them in the last row; drawn in 255 steps."""
        lo, hi = result.camera.defocus_range
        psi = [hi + (lo - hi) * column / (COLUMNS - 1)]
        with torch.no_grad():
            alone = [result.optics.through_state(k).psf_bank(defocus=psi).psfs[0] for k in range(3)]
            average = result.optics.psf_bank(defocus=psi).psfs[0]
        for row, psf in enumerate([*alone, average]):
            assert np.abs(cell(panel, row, column) - psf_cell(psf)).max() < 1.5 / 255

    def test_feature_each_row_begins_with_its_mask(self, result, panel):
        for row, mask in enumerate(mask_colors(result.optics)):
            assert np.abs(cell(panel, row, -1) - mask).max() < 1.5 / 255

    def test_feature_depths_and_signs_of_defocus_stand_above_their_columns(self, result, monkeypatch):
        """The defocus of a thin lens, pi R^2 / 530 nm (1/z - 1/0.595 m), of the depths as they are written."""
        monkeypatch.setattr(pictures, "_pixels", lambda figure: figure)
        texts = sorted(
            (text.get_position()[0], text.get_text()) for text in pictures.masks_and_psfs(result).axes[0].texts
        )
        depths = [float(words.removesuffix(" m")) for _, words in texts if words.endswith(" m")]
        psi = [float(words[4:].replace("\N{MINUS SIGN}", "-")) for _, words in texts if words.startswith("ψ = ")]
        assert len(depths) == len(psi) == COLUMNS
        assert depths == sorted(depths)
        radius = 0.05 / 17.6 / 2
        for depth, defocus in zip(depths, psi, strict=True):
            expected = np.pi * radius**2 / 530e-9 * (1 / depth - 1 / 0.595)
            rounded = 0.5 + np.pi * radius**2 / 530e-9 * 0.005 / depth  # three digits of the depth, whole radians
            assert abs(defocus - expected) <= rounded

    def test_convention_a_psf_is_drawn_as_it_lies_on_the_sensor(self):
        psf = torch.zeros(3, 2, 2)
        psf[0, 0, 1], psf[2, 1, 0] = 1.0, 1.0
        drawn = psf_cell(psf)
        assert drawn[0, -1].tolist() == [1, 0, 0]
        assert drawn[-1, 0].tolist() == [0, 0, 1]

    def test_convention_a_mask_is_drawn_as_it_lies_in_the_pupil(self):
        """Half a wave in one pixel: the middle of the colours there, their beginning elsewhere, a wave added or not."""
        optics = take_picture(Settings(camera="own", start="flat", **SMALL)).optics
        optics.masks.phase.data[0, 9, 15] += 3 * np.pi
        optics.masks.phase.data[0, 13, 6] += 2 * np.pi
        (mask,) = mask_colors(optics)
        pixels = mask[np.ix_(*[((np.arange(23) + 0.5) * CELL / 23).astype(int)] * 2)]
        colors = matplotlib.colormaps[PHASE_COLORS]
        assert pixels[9, 15] == pytest.approx(colors(0.5)[:3], abs=0.02)
        assert pixels[15, 9] == pytest.approx(colors(0.0)[:3], abs=0.02)
        assert min(abs(pixels[13, 6] - colors(end)[:3]).max() for end in (0.0, 1.0)) < 0.02


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
