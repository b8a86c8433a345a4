"""What every backend of the registry promises: the dense render, its gradients, and one sentence where it refuses."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.render.dispatch import BACKENDS, refusal
from kornia_tidy.render.scene import layered_scene
from tests.base import BaseTester
from tests.render.render_tester import RenderTester
from tests.render.scenes import make_bank, make_scene

OTHERS = [name for name in BACKENDS if name != "dense"]
# Sums of some 1e3 products of light below 1, in any order; occlusion divides them by what a layer is seen by.
ROUNDING = {
    (torch.float32, False): 2e-6,
    (torch.float32, True): 2e-5,
    (torch.float64, False): 1e-12,
    (torch.float64, True): 1e-9,
}
# Batch, maps, channels, side of the PSFs, height and width: small and large PSFs, and a picture of a few pixels.
SHAPES = ((2, 1, 2, 5, 31, 46), (1, 1, 1, 15, 37, 50), (2, 2, 1, 3, 5, 6))

over_backends = pytest.mark.parametrize("name", OTHERS)
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)
over_layers = pytest.mark.parametrize("layers", ["nearest", "linear"])


class TestEveryBackend(RenderTester):
    @over_backends
    @over_compositing
    @over_layers
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, name, compositing, layers, border, device, dtype):
        seen = 0
        for batch, maps, channels, size, height, width in SHAPES:
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            scene = layered_scene(
                image, defocus, bank.defocus, bank.psfs, bank.veil, compositing=compositing, **options
            )
            if refusal(BACKENDS[name], scene) is None:
                atol, seen = ROUNDING[dtype, compositing == "occlusion"], seen + 1
                self.assert_equals_dense(name, image, defocus[:maps], bank, compositing, atol, **options)
        if not seen:
            pytest.skip(f"{name} supports none of these scenes here: {refusal(BACKENDS[name], scene)}")

    @over_backends
    @over_compositing
    @over_layers
    @pytest.mark.parametrize(("border", "size", "maps"), [("reflect", 5, 1), ("zero", 9, 2), ("valid", 7, 1)])
    def test_gradcheck_equals_the_dense_gradients(self, name, compositing, layers, border, size, maps, device):
        """To image, defocus, PSFs and veil."""
        bank = make_bank(4, 1, size, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 24, 46)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing, border=border)
        if (why := refusal(BACKENDS[name], scene)) is not None:
            pytest.skip(why)
        atol = 1e-8 if compositing == "occlusion" else 1e-11
        options = {"layers": layers, "border": border}
        self.assert_gradients_equal_dense(name, image, defocus[:maps], bank, compositing, atol, **options)


class TestWork(BaseTester):
    @pytest.mark.parametrize("name", BACKENDS)
    @over_compositing
    def test_feature_work_grows_with_the_image_and_is_counted_from_layers_alone(self, name, compositing):
        works = []
        for side in (192, 384):
            bank = make_bank(5, 2, 11, dtype=torch.float32)
            image, defocus = make_scene(bank, 1, side, side)
            for light in (image, torch.full_like(image, float("nan"))):
                scene = layered_scene(light, defocus, bank.defocus, bank.psfs, compositing=compositing)
                if (why := refusal(BACKENDS[name], scene)) is not None:
                    pytest.skip(why)
                works.append(BACKENDS[name].work(scene))
        assert works[0] == works[1]
        assert works[2] == works[3]
        assert 3 < works[2].operations / works[0].operations < 5  # of four times the pixels
        assert works[0].memory < works[2].memory
