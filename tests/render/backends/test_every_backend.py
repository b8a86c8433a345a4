"""What every backend promises: the dense render, its gradients alone and together, half types; refusals in a sentence.

Batched rendering is tried twice: with the tiles that it chooses, and with so small ones that these scenes have many.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.render import layered_scene
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.render.dispatch import BACKENDS, refusal
from tests.base import BaseTester
from tests.render.render_tester import SMALL_TILES, RenderTester, render_by
from tests.render.scenes import HARD, Bank, hard_depth, make_bank, make_scene, squares

OTHERS = {**{name: backend for name, backend in BACKENDS.items() if name != "dense"}, "small tiles": SMALL_TILES}
# Sums of some 1e3 products of light below 1, in any order; occlusion divides them by what a layer is seen by.
ROUNDING = {
    (torch.float32, False): 2e-6,
    (torch.float32, True): 2e-5,
    (torch.float64, False): 1e-12,
    (torch.float64, True): 1e-9,
}
# Batch, maps, channels, side of the PSFs, height and width: small and large PSFs, and a picture of a few pixels.
SHAPES = ((2, 1, 2, 5, 31, 46), (1, 1, 1, 15, 37, 50), (2, 2, 1, 3, 5, 6), (3, 3, 2, 1, 17, 40))

over_backends = pytest.mark.parametrize("backend", OTHERS.values(), ids=OTHERS)
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)
over_layers = pytest.mark.parametrize("layers", ["nearest", "linear"])


class TestEveryBackend(RenderTester):
    @over_compositing
    @over_layers
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, compositing, layers, border, device, dtype):
        """Where depth is noise, and in squares that leave tiles of one layer: by turns over borders and shapes."""
        for turn, (batch, maps, channels, size, height, width) in enumerate(SHAPES, BORDERS.index(border)):
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            psi = squares(bank, height, width, 15) if turn % 2 else defocus[:maps]
            atol = ROUNDING[dtype, compositing == "occlusion"]
            self.assert_all_equal_dense(image, psi, bank, compositing, atol, **options)

    @over_compositing
    @over_layers
    @pytest.mark.parametrize("kind", HARD)
    def test_feature_equals_the_dense_render_of_hard_scenes(self, compositing, layers, kind, device, dtype):
        """By direct sums and by windows, each in one data type for nearest layers and in the other for linear ones."""
        atol = {torch.float32: 2e-6, torch.float64: 1e-12}[dtype] * (10 if compositing == "occlusion" else 1)
        size, border = (5, "reflect") if (dtype == torch.float32) == (layers == "nearest") else (11, "zero")
        bank = make_bank(6, 2, size, dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 45, 83)[0], hard_depth(kind, bank, 45, 83)
        self.assert_all_equal_dense(image, defocus, bank, compositing, atol, layers=layers, border=border)

    @over_compositing
    @given(data=st.data())
    @settings(max_examples=30)
    def test_property_equals_the_dense_render_at_any_size(self, compositing, data):
        draw, occludes = data.draw, compositing == "occlusion"
        torch.manual_seed(draw(st.integers(0, 99)))
        radius, border = draw(st.integers(0, 9)), draw(st.sampled_from(BORDERS))
        smallest = {"reflect": radius + 1, "circular": max(radius, 1), "valid": 2 * radius + 1}.get(border, 1)
        height, width = (draw(st.integers(smallest, 90)) for _ in range(2))
        bank = make_bank(draw(st.integers(1, 6)), draw(st.sampled_from([1, 3])), 2 * radius + 1, light=0.7, veil=True)
        image, defocus = make_scene(bank, draw(st.integers(1, 3)), height, width)
        kind = draw(st.sampled_from(["random", "one for all", *HARD]))
        if occludes:  # where a PSF has no light, round-off is divided by epsilon
            bank = replace(bank, psfs=bank.psfs + 0.5 / (2 * radius + 1) ** 2)
            defocus = squares(bank, height, width, draw(st.integers(1, 60)))
        elif kind != "random":
            defocus = defocus[:1] if kind == "one for all" else hard_depth(kind, bank, height, width)
        options = {"layers": draw(st.sampled_from(["nearest", "linear"])), "border": border}
        self.assert_all_equal_dense(image, defocus, bank, compositing, 1e-11 if occludes else 1e-12, **options)

    @over_backends
    @over_compositing
    @over_layers
    @pytest.mark.parametrize(("border", "size", "maps"), [("reflect", 5, 1), ("zero", 9, 2), ("valid", 7, 1)])
    def test_gradcheck_equals_the_dense_gradients(
        self, backend, compositing, layers, border, size, maps, device, dtype
    ):
        """To image, defocus, PSFs and veil."""
        bank = make_bank(4, 1, size, dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 24, 46)
        options = {"layers": layers, "border": border}
        if (why := self.refused(backend, image, defocus, bank, compositing, **options)) is not None:
            pytest.skip(why)
        if compositing == "occlusion" and dtype == torch.float32:
            defocus = squares(bank, 24, 46, 15).expand(2, -1, -1, -1) + 0.5  # in noise divisors come near to nothing
        atol = 2e-5 if dtype == torch.float32 else 1e-8 if compositing == "occlusion" else 1e-11
        self.assert_gradients_equal_dense(backend, image, defocus[:maps], bank, compositing, atol, **options)

    @over_backends
    @over_compositing
    @pytest.mark.parametrize("wanted", range(4))
    def test_gradcheck_each_gradient_can_be_had_alone(self, backend, compositing, wanted, device):
        bank = make_bank(4, 1, 5, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 31, 46)
        if (why := self.refused(backend, image, defocus, bank, compositing)) is not None:
            pytest.skip(why)
        inputs = [image, squares(bank, 31, 46, 20) + 0.5, bank.psfs, bank.veil]
        inputs[wanted] = inputs[wanted].clone().requires_grad_()
        gradients = []
        for method in (backend, "dense"):
            coded = render_by(method, *inputs[:2], Bank(inputs[2], bank.defocus, inputs[3]), compositing)
            gradients.append(torch.autograd.grad(coded.square().sum(), inputs[wanted])[0])
        self.assert_close(*gradients, rtol=1e-9, atol=1e-11)

    @over_backends
    @over_compositing
    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_feature_half_is_the_dense_render_to_its_last_place(self, backend, compositing, half, device):
        bank = make_bank(6, 3, 7, dtype=torch.float32, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 44, 37)
        image, bank = image.to(half), bank.to(half)
        if (why := self.refused(backend, image, defocus, bank, compositing)) is not None:
            pytest.skip(why)
        coded = render_by(backend, image, defocus, bank, compositing)
        expected = render(image, defocus, bank, compositing, method="dense")
        assert coded.dtype == half
        self.assert_close(coded, expected, rtol=torch.finfo(half).eps, atol=1e-6)

    @over_backends
    @over_compositing
    def test_feature_absent_layers_are_not_looked_at(self, backend, compositing, device, dtype):
        bank = make_bank(6, 1, 7, dtype=dtype, device=device)
        image, defocus = make_scene(bank, 1, 20, 70)
        if (why := self.refused(backend, image, defocus, bank, compositing)) is not None:
            pytest.skip(why)
        defocus = torch.full_like(defocus, -7.0)  # between nodes 1 and 2
        defocus[..., 40:] = bank.defocus[1]
        expected = render_by(backend, image, defocus, bank, compositing)
        bank.psfs[[0, 3, 4, 5]] = float("nan")
        assert torch.equal(render_by(backend, image, defocus, bank, compositing), expected)

    def assert_all_equal_dense(self, image, defocus, bank, compositing, atol, **options) -> None:
        """Compare every backend that supports a scene with the dense one."""
        expected = render(image, defocus, bank, compositing, method="dense", **options)
        for backend in OTHERS.values():
            if self.refused(backend, image, defocus, bank, compositing, **options) is None:
                found = render_by(backend, image, defocus, bank, compositing, **options)
                self.assert_close(found, expected, rtol=0, atol=atol)

    @staticmethod
    def refused(backend, image, defocus, bank, compositing, **options) -> str | None:
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, bank.veil, compositing=compositing, **options)
        return refusal(backend, scene)


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
        plane = 4 * image.numel() * (2 if compositing == "occlusion" else 1)  # which computes in float64
        assert name != "dense" or works[2].memory > 8 * plane  # spectra of light, weights and PSFs among them
