"""Collages: reproducible, made of the photographs alone, anti-aliased in linear light, with exact depth."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
import torch
from kornia.color import rgb_to_linear_rgb

from kornia_tidy.data import photo_collage, photographs_in
from kornia_tidy.data import photo_collages as module
from kornia_tidy.data.photo_collages import _cut, displaced, grain
from tests.base import BaseTester

COLOURS = {"red": (200, 30, 20), "green": (25, 150, 60), "blue": (30, 60, 220)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three photographs of one colour each, a grey one in a folder of its own, and a file that is none."""
    root = tmp_path_factory.mktemp("photographs")
    for name, colour in COLOURS.items():
        assert cv2.imwrite(str(root / f"{name}.PNG"), np.full((60, 90, 3), colour[::-1], np.uint8))
    (root / "more").mkdir()
    assert cv2.imwrite(str(root / "more" / "grey.jpg"), np.full((50, 40), 128, np.uint8))
    (root / "notes.txt").write_text("no photograph")
    return root


@pytest.fixture(autouse=True)
def _as_photographed(request, monkeypatch):
    """Unless a test is about them, shapes are exposed and tinted as the photographs, no scene is softened or grainy."""
    if "varied" not in request.fixturenames:
        monkeypatch.setattr(module, "EXPOSURE", 0.0)
        monkeypatch.setattr(module, "TINT", 0.0)
        monkeypatch.setattr(module, "GRAINY_SHARE", 0.0)
        monkeypatch.setattr(sys.modules["kornia_tidy.data.photographic_leaves"], "SOFT_SHARE", 0.0)


@pytest.fixture
def varied():
    """Exposure, tint, softness and grain as they are."""


class TestPhotographs(BaseTester):
    def test_feature_photographs_of_a_folder_and_those_below(self, folder):
        assert [path.name for path in photographs_in(folder)] == ["blue.PNG", "green.PNG", "grey.jpg", "red.PNG"]

    def test_exception_no_folder_or_no_photographs(self, folder, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"there is no folder .*nowhere: it must hold photographs \(.png, "):
            photographs_in(folder / "nowhere")
        with pytest.raises(FileNotFoundError, match="holds no photographs"):
            photographs_in(tmp_path)


class TestPhotoCollage(BaseTester):
    def in_no_scene_and_in_each(self, share, folder, monkeypatch):
        """Return one scene, image and depth, with a share of scenes at 0, and with it at 1."""
        scenes = []
        for value in (0.0, 1.0):
            monkeypatch.setattr(module, share, value)
            scenes.append(photo_collage(photographs_in(folder), 64, 64, depth_range=(1.0, 2.0), seed=4))
        return scenes

    def test_feature_pixels_are_of_the_photographs_and_at_outlines_quarters_of_them_in_linear_light(self, folder):
        """Each of a pixel's four samples shows one of the photographs; all mixtures of four of them are listed."""
        paths = [folder / f"{name}.PNG" for name in COLOURS]
        seen = set()
        light = rgb_to_linear_rgb(torch.tensor(list(COLOURS.values())).reshape(3, 3, 1, 1) / 255)[..., 0, 0].double()
        parts = torch.cartesian_prod(*(torch.arange(5) for _ in COLOURS))
        parts = parts[parts.sum(1) == 4]
        mixtures = parts.double() @ light / 4
        for seed in range(40):
            image, _ = photo_collage(paths, 64, 64, seed=seed)
            pixels = rgb_to_linear_rgb(image[None])[0].flatten(1).T.double()
            away = (pixels[:, None] - mixtures).abs().amax(-1)
            assert away.min(1).values.max() < 1e-5
            seen |= set(away.argmin(1).tolist())
        assert seen >= set((parts > 0).sum(1).le(2).nonzero()[:, 0].tolist())  # three meet in few pixels

    def test_feature_shapes_differ_in_exposure_and_tint(self, folder, varied):
        image, _ = photo_collage([folder / "more" / "grey.jpg"], 200, 200, seed=3)
        light = rgb_to_linear_rgb(image[None])[0].flatten(1)
        assert light.mean(0).std() > 0.01
        assert (light[0] / light[2]).std() > 0.01

    def test_feature_photographs_are_reduced_and_smaller_ones_enlarged(self, tmp_path, monkeypatch):
        """Across a ramp of light whose slope tells the scale."""
        ramp = np.tile(np.linspace(0, 60000, 300)[None, :, None], (200, 1, 3)).astype(np.uint16)
        assert cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
        monkeypatch.setattr(module, "rgb_to_linear_rgb", lambda image: image)
        slope = float(60000 / 65535 / 299)
        for draw, size, reduction in ((0.0, 40, 0.5), (1.0, 40, 1.5), (0.5, 400, 0.5)):
            cut = _cut(tmp_path / "ramp.png", size, size, np.array((draw, 0.5, 0.5, 1.0)))
            found = float(np.diff(cut[size // 2, 5:-5, 0]).mean())
            assert found == pytest.approx(slope * reduction, rel=0.03), (draw, size)

    def test_feature_contrast_is_that_of_texture_and_leaves_the_light_around_it(self, tmp_path, monkeypatch):
        """Of a board of single dark and bright pixels."""
        board = np.where(np.indices((96, 96)).sum(0) % 2, 200, 60).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / "board.png"), board)
        monkeypatch.setattr(module, "REDUCTION", (2.0, 2.0))  # a pixel of the file for each sample
        monkeypatch.setattr(module, "BLANK_SHARE", 0.0)
        index = np.zeros((96, 96), np.int32)
        found = {}
        for contrast in (1.0, 0.25):
            monkeypatch.setattr(module, "CONTRAST", (contrast, contrast))
            light = module._collage(index, [tmp_path / "board.png"], np.random.default_rng(0))
            found[contrast] = (float(light.mean()), float(light.std()))
        assert found[0.25] == (pytest.approx(found[1.0][0], rel=1e-3), pytest.approx(found[1.0][1] / 4, rel=1e-3))

    def test_feature_a_share_of_shapes_is_blank(self, tmp_path, monkeypatch):
        """Of 576 squares of a board: within five standard deviations of the binomial distribution."""
        board = np.where(np.indices((96, 96)).sum(0) % 2, 200, 60).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / "board.png"), board)
        monkeypatch.setattr(module, "REDUCTION", (2.0, 2.0))
        index = np.arange(576, dtype=np.int32).reshape(24, 24).repeat(4, 0).repeat(4, 1)
        light = module._collage(index, [tmp_path / "board.png"], np.random.default_rng(0))
        squares = light.reshape(24, 4, 24, 4, 3).transpose(0, 2, 1, 3, 4).reshape(576, 16, 3)
        blank = (np.ptp(squares, axis=1) < 1e-3 * squares.mean(1)).all(1)
        share = module.BLANK_SHARE
        assert abs(blank.sum() - 576 * share) < 5 * (576 * share * (1 - share)) ** 0.5

    def test_feature_outlines_of_depth_lie_beside_those_of_the_image_in_a_share_of_scenes(self, folder, monkeypatch):
        (image, depth), (same, moved) = self.in_no_scene_and_in_each("DISPLACED_SHARE", folder, monkeypatch)
        assert torch.equal(image, same)
        assert 0.01 < (depth != moved).float().mean() < 0.9  # planes are tilted, so that most depths differ by a little
        assert (depth - moved).abs().mean() < 0.1

    @pytest.mark.parametrize("seed", range(4))
    def test_feature_an_outline_is_moved_in_smooth_waves_and_raggedly(self, seed):
        """By all of the offset, and by what six standard deviations allow."""
        plane = np.repeat([[0.0, 1.0]], 64, 1).repeat(400, 0)
        moved = displaced(plane, np.random.default_rng(seed))
        assert set(moved.flat) == {0.0, 1.0}
        place = 128 - moved.sum(1)  # of the outline in each row
        assert abs(place - 64).max() <= module.OFFSET + 6 * (module.WAVE + module.RAGGED)
        assert 0.5 < place.std() < 6
        near, far = (np.corrcoef(place[:-step], place[step:])[0, 1] for step in (1, 150))
        assert near > max(0.3, far)

    def test_feature_a_share_of_scenes_has_grain(self, folder, monkeypatch):
        (image, depth), (grainy, same) = self.in_no_scene_and_in_each("GRAINY_SHARE", folder, monkeypatch)
        assert torch.equal(depth, same)
        assert module.GRAIN[0] / 2 < (grainy - image).std() < module.GRAIN[1]  # less where it is clipped

    @pytest.mark.parametrize("size", [0.5, 1.5, 3.0])
    def test_feature_grain_has_its_strength_size_and_colour(self, size, monkeypatch):
        """Of white noise blurred by a Gaussian, neighbours correlate by exp(-1 / (4 size^2))."""
        monkeypatch.setattr(module, "GRAIN", (0.01, 0.01))
        monkeypatch.setattr(module, "GRAIN_SIZE", (size, size))
        drawn = grain(400, 300, np.random.default_rng(0)).astype(np.float64)
        independent = drawn[0].size / (4 * np.pi * size**2)  # samples, about
        bound = 6 / np.sqrt(independent)
        assert drawn.std() == pytest.approx(0.01, rel=1e-5)
        assert abs(drawn.mean()) < bound * 0.01
        for step in (drawn[:, 1:] * drawn[:, :-1], drawn[:, :, 1:] * drawn[:, :, :-1]):
            sampled = np.exp(-(np.arange(-9, 10) ** 2) / (2 * size**2))  # as OpenCV samples the Gaussian
            expected = (sampled[1:] @ sampled[:-1]) / (sampled @ sampled)
            assert step.mean() / 0.01**2 == pytest.approx(expected, abs=bound)
        between = np.corrcoef(drawn.reshape(3, -1))[np.triu_indices(3, 1)]
        assert abs(between - (1 - module.GRAIN_COLOR)).max() < bound

    def test_exception_a_photograph_that_cannot_be_read(self, tmp_path):
        (tmp_path / "a.png").write_bytes(b"no picture")
        with pytest.raises(ValueError, match=r"a\.png"):
            photo_collage([tmp_path / "a.png"], 8, 8)
