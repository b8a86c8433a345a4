"""A defocus map that comes again keeps its layers; one that differs anywhere does not."""

from __future__ import annotations

from unittest.mock import patch

import pytest
import torch

from kornia_tidy.render import scene as module
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.render.scene import SceneArguments, assigned_scene, remembered_scene
from tests.base import BaseTester
from tests.render.scenes import make_bank, make_scene

OPTIONS = ("gather", "linear", "reflect", False)


class TestRememberedScene(BaseTester):
    @pytest.fixture(autouse=True)
    def nothing_remembered(self):
        with patch.dict(module._last, clear=True):
            yield

    def given(self, dtype=torch.float32):
        bank = make_bank(5, 2, 5, dtype=dtype)
        image, defocus = make_scene(bank, 2, 31, 46)
        return [image, defocus.to(dtype), bank.defocus, bank.psfs, None]

    def test_smoke(self):
        tensors = self.given()
        first, second = (remembered_scene(SceneArguments(*tensors, *OPTIONS)) for _ in range(2))
        assert second.labels is first.labels

    def test_feature_image_and_psfs_are_those_given_now(self):
        tensors = self.given()
        remembered_scene(SceneArguments(*tensors, *OPTIONS))
        tensors[0], tensors[3] = tensors[0] / 2, tensors[3] / 3
        scene = remembered_scene(SceneArguments(*tensors, "gather", "linear", "reflect", True))
        self.assert_close(scene.image, tensors[0], rtol=0, atol=0)
        self.assert_close(scene.psfs, tensors[3].flip((-2, -1)), rtol=0, atol=0)

    def test_feature_a_map_changed_in_place_is_assigned_again(self):
        tensors = self.given()
        first = remembered_scene(SceneArguments(*tensors, *OPTIONS))
        tensors[1][0, 0, 7, 9] = float(tensors[2][3])
        second = remembered_scene(SceneArguments(*tensors, *OPTIONS))
        assert second.labels is not first.labels
        expected = assigned_scene(SceneArguments(*tensors, *OPTIONS))
        self.assert_close(second.layer_index, expected.layer_index, rtol=0, atol=0)
        self.assert_close(second.layer_weight, expected.layer_weight, rtol=0, atol=0)

    @pytest.mark.parametrize(
        "options",
        [
            ("scatter", "linear", "reflect", False),
            ("gather", "nearest", "reflect", False),
            ("gather", "linear", "valid", False),
        ],
    )
    def test_feature_other_options_are_assigned_again(self, options):
        tensors = self.given()
        first, second = (
            remembered_scene(SceneArguments(*tensors, *OPTIONS)),
            remembered_scene(SceneArguments(*tensors, *options)),
        )
        assert second.labels is not first.labels
        assert (second.compositing, second.border) == options[::2]

    def test_feature_other_nodes_are_assigned_again(self):
        tensors = self.given()
        first = remembered_scene(SceneArguments(*tensors, *OPTIONS))
        tensors[2] = tensors[2] + 0.5
        assert remembered_scene(SceneArguments(*tensors, *OPTIONS)).labels is not first.labels

    def test_feature_large_maps_are_not_remembered(self):
        with patch.object(module, "LARGEST_REMEMBERED", 100):
            remembered_scene(SceneArguments(*self.given(), *OPTIONS))
        assert not module._last

    @pytest.mark.parametrize("method", ["auto", "tiled", "dense"])
    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_feature_second_rendering_is_the_first_to_the_last_digit(self, compositing, method):
        bank = make_bank(5, 2, 5, dtype=torch.float32)
        image, defocus = make_scene(bank, 2, 31, 46)
        first, again = (render(image, defocus, bank, compositing, method=method) for _ in range(2))
        self.assert_close(again, first, rtol=0, atol=0)
