"""Occlusion against models that share no code with it, its physics, and the batched renderer against the dense one."""

from __future__ import annotations

import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.dense_occlusion import EPSILON, cumulative_weight, lay_over
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import gather, occlusion, render
from kornia_tidy.render.layers import layer_weights
from tests.base import BaseTester
from tests.render.backends.test_batched import KINDS, LargestTensor, depth_map
from tests.render.render_tester import METHODS, SMALL_TILES, RenderTester, render_by
from tests.render.scenes import Bank, brute_render, make_bank, make_scene, modelled
from tests.rounding import gamma

ATOL = {torch.float32: 2e-5, torch.float64: 1e-12}


def steps(bank, height, width, side=11):
    """A defocus map of squares, with tiles of one layer and of several."""
    y, x = torch.arange(height)[:, None] // side, torch.arange(width) // side
    return bank.defocus[((y * 3 + x * 5) % len(bank.defocus)).to(bank.defocus.device)][None, None]


def near_on_far(size, side, device, dtype):
    """A defocus map of a near square (10 rad) on a far ground (0 rad)."""
    defocus = torch.zeros(1, 1, size, size, device=device, dtype=dtype)
    start = (size - side) // 2
    defocus[..., start : start + side, start : start + side] = 10
    return defocus


class TestOcclusion(BaseTester):
    @pytest.mark.parametrize("method", METHODS)
    def test_smoke(self, method, device, dtype):
        bank = make_bank(dtype=dtype, device=device)
        image, defocus = make_scene(bank)
        coded = render(image, defocus, bank, "occlusion", method=method)
        assert coded.shape == image.shape
        assert coded.dtype == dtype
        assert coded.device == image.device

    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("size", [(7, 8), (8, 7), (16, 5), (9, 9)], ids=str)
    @pytest.mark.parametrize("channels", [1, 3])
    def test_cardinality(self, border, size, channels, device):
        bank = make_bank(channels=channels, dtype=torch.float32, device=device)
        lost = 4 if border == "valid" else 0
        shape = render(*make_scene(bank, 2, *size), bank, "occlusion", border=border).shape
        assert shape == (2, channels, size[0] - lost, size[1] - lost)

    # Against models that share no code with the renderer

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("method", METHODS)
    def test_feature_equals_the_sum_over_pixels(self, layers, border, method, device):
        for count, channels, size, height, width in ((4, 1, 3, 5, 6), (1, 2, 5, 5, 7), (3, 1, 1, 2, 3)):
            bank = make_bank(count, channels, size, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, 2, height, width)
            options = {"compositing": "occlusion", "layers": layers, "border": border}
            expected = brute_render(image, defocus, bank, **options)
            self.assert_close(render(image, defocus, bank, method=method, **options), expected, rtol=0, atol=1e-12)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular"])
    @pytest.mark.parametrize("method", METHODS)
    def test_feature_equals_the_independent_model(self, border, method):
        bank = make_bank(6, 3, 7)
        for height, width in ((33, 40), (48, 41)):
            image, _ = make_scene(bank, 1, height, width)
            defocus = steps(bank, height, width)
            expected = modelled(image, defocus, bank, "occlusion", border)
            coded = render(image, defocus, bank, "occlusion", layers="nearest", border=border, method=method)
            self.assert_close(coded[0], expected, rtol=0, atol=1e-10)  # our round-off, divided by EPSILON or more

    def test_feature_correlate_turns_the_psfs(self, device, dtype):
        bank = make_bank(dtype=dtype, device=device)
        image, defocus = make_scene(bank)
        turned = Bank(bank.psfs.flip((-2, -1)), bank.defocus)
        expected = render(image, defocus, turned, "occlusion")
        assert torch.equal(render(image, defocus, bank, "occlusion", correlate=True), expected)

    def test_feature_render_is_the_function_it_names(self, device, dtype):
        bank = make_bank(dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank)
        options = {"layers": "nearest", "border": "zero", "correlate": True}
        expected = occlusion(image, defocus, bank.defocus, bank.psfs, bank.veil, **options)
        assert torch.equal(render(image, defocus, bank, "occlusion", **options), expected)

    def test_feature_cumulative_weight_adds_up_the_layers(self, device):
        bank = make_bank(6, device=device)
        _, defocus = make_scene(bank)
        lower = torch.bucketize(defocus.clamp(-20, 20), bank.defocus[1:-1])
        fraction = (defocus.clamp(-20, 20) - bank.defocus[lower]) / bank.defocus.diff()[lower]
        weights = layer_weights(defocus, bank.defocus, "linear")
        for index in range(6):
            expected = weights[:, : index + 1].sum(1, keepdim=True)
            self.assert_close(cumulative_weight(lower, fraction, index), expected, rtol=0, atol=1e-14)
            assert torch.equal(cumulative_weight(lower, None, index), lower <= index)

    def test_feature_a_negative_divisor_counts_as_none(self, device, dtype):
        """Interpolated PSFs can be negative in places."""
        light, seen = torch.tensor(1e-7, device=device, dtype=dtype), torch.tensor(-5.0, device=device, dtype=dtype)
        self.assert_close(lay_over([(light, light, seen)]), light / EPSILON, rtol=1e-6, atol=0)

    # Physics

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("border", ["reflect", "replicate", "circular", "valid"])
    def test_property_one_layer_equals_gather(self, method, border, device, dtype):
        bank = make_bank(4, 3, 7, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 37, 30)
        defocus = bank.defocus[2].expand(1, 1, 37, 30)
        expected = gather(image, defocus, bank.defocus, bank.psfs, bank.veil, border=border)
        coded = render(image, defocus, bank, "occlusion", border=border, method=method)
        # What is seen of the layer is divided by itself and EPSILON; light is at most 1.
        self.assert_close(coded, expected, rtol=0, atol=EPSILON + 3 * gamma(7 * 7 + 8, dtype))

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_property_white_stays_white(self, method, layers, border, device, dtype):
        """To epsilon over the smallest share of a PSF by which a layer is seen; here a pixel of a 5 x 5 PSF or more."""
        psfs = make_bank(6, 3, 5, dtype=dtype, device=device).psfs + 0.04
        bank = Bank(psfs / psfs.sum((-2, -1), keepdim=True), make_bank(6, device=device, dtype=dtype).defocus)
        image, defocus = make_scene(bank, 2, 24, 17)
        white = render(
            torch.ones_like(image), steps(bank, 24, 17), bank, "occlusion", layers=layers, border=border, method=method
        )
        assert float(bank.psfs.min()) > 0.015
        self.assert_close(white, torch.ones_like(white), rtol=0, atol=EPSILON / 0.015)
        speckled = render(torch.ones_like(image), defocus, bank, "occlusion", border=border, method=method)
        assert float((speckled - 1).abs().max()) < 1e-3  # a pixel's own layer may have a weight of near to nothing

    @pytest.mark.parametrize("method", METHODS)
    def test_property_a_near_opaque_layer_hides_the_far_one(self, method, device, dtype):
        """Within the square by more than a PSF's radius nothing of the ground's light arrives; gather lets it in."""
        bank = Bank(make_bank(2, 1, 7, dtype=dtype, device=device).psfs, torch.tensor([0.0, 10.0], device=device))
        defocus = near_on_far(41, 21, device, dtype)
        ground = (defocus == 0).to(dtype) * 100
        coded = render(ground, defocus, bank, "occlusion", layers="nearest", method=method)
        assert float(coded[..., 13:28, 13:28].abs().max()) < 1e-9
        assert float(coded[..., :7, :].min()) > 99.9

    @pytest.mark.parametrize("method", METHODS)
    def test_property_a_sharp_near_edge_does_not_bleed(self, method, device, dtype):
        """An occluder in focus on a blurred ground: each of its pixels is its own, and the ground beside it is ground.

        Gather instead brings the ground's blur of the occluder onto the ground.
        """
        psfs = torch.zeros(2, 1, 7, 7, device=device, dtype=dtype)
        psfs[1, 0, 3, 3] = 1
        psfs[0] = 1 / 49
        bank = Bank(psfs, torch.tensor([0.0, 10.0], device=device))
        defocus = near_on_far(31, 11, device, dtype)
        near = defocus == 10
        image = torch.where(near, 0.9, 0.2).to(dtype)
        coded = render(image, defocus, bank, "occlusion", layers="nearest", method=method)
        self.assert_close(coded, image, rtol=0, atol=1e-4)
        assert float((render(image, defocus, bank, layers="nearest") - image).abs().max()) > 0.1

    @pytest.mark.parametrize("method", METHODS)
    def test_property_a_blurred_near_edge_is_the_mix_of_both(self, method, device, dtype):
        """Plain near, plain ground: the share of the near layer's PSF that sees it, and the ground for the rest."""
        bank = Bank(make_bank(2, 1, 7, dtype=dtype, device=device).psfs, torch.tensor([0.0, 10.0], device=device))
        defocus = near_on_far(41, 21, device, dtype)
        near = (defocus == 10).to(dtype)
        coded = render(0.2 + 0.7 * near, defocus, bank, "occlusion", layers="nearest", method=method)
        share = gather(near, torch.full_like(near, 10), bank.defocus, bank.psfs)
        ground = gather(1 - near, torch.zeros_like(near), bank.defocus, bank.psfs)
        mixed = 0.9 * share + 0.2 * (1 - share)
        sees_ground = ground > 1e-3
        self.assert_close(coded[sees_ground], mixed[sees_ground], rtol=0, atol=1e-3)

    @given(seed=st.integers(0, 99), border=st.sampled_from(BORDERS), layers=st.sampled_from(["nearest", "linear"]))
    @settings(max_examples=25)
    def test_property_light_is_never_negative_nor_beyond_the_brightest(self, seed, border, layers):
        torch.manual_seed(seed)
        bank = make_bank(5, 1, 5)
        image, defocus = make_scene(bank, 1, 20, 33)
        coded = render(image, defocus, bank, "occlusion", border=border, layers=layers)
        assert float(coded.min()) > -1e-9
        assert float(coded.max()) < 1 + 1e-9

    @given(a=st.floats(0, 5), b=st.floats(0, 5), seed=st.integers(0, 99))
    @settings(max_examples=15)
    def test_property_rendering_is_linear_in_the_image(self, a, b, seed):
        torch.manual_seed(seed)
        bank = make_bank(3, 1, 5, light=0.9, veil=True)
        (first, defocus), (second, _) = make_scene(bank), make_scene(bank)
        coded = [render(x, defocus, bank, "occlusion") for x in (first, second, a * first + b * second)]
        self.assert_close(coded[2], a * coded[0] + b * coded[1], rtol=0, atol=1e-10)

    def test_feature_float32_is_float64_where_divisors_vanish(self, device):
        """PSFs with tails of 1e-9, by which layers are hardly seen: round-off of float32 would show as 1e-2."""
        psfs = torch.rand(6, 1, 15, 15, device=device, dtype=torch.float64) ** 12
        bank = Bank(psfs / psfs.sum((-2, -1), keepdim=True), make_bank(6, device=device).defocus)
        image, _ = make_scene(bank, 1, 70, 80)
        defocus = steps(bank, 70, 80)
        single = Bank(bank.psfs.float(), bank.defocus.float())
        expected = render(image, defocus, bank, "occlusion", layers="nearest", method="dense")
        for method in METHODS:
            coded = render(image.float(), defocus.float(), single, "occlusion", layers="nearest", method=method)
            self.assert_close(coded.double(), expected, rtol=0, atol=2e-5)

    # What is skipped, shared and shaped

    @pytest.mark.parametrize("method", METHODS)
    def test_feature_absent_layers_are_not_looked_at(self, method, device, dtype):
        bank = make_bank(6, 1, 5, dtype=dtype, device=device)
        image, _ = make_scene(bank)
        defocus = torch.full((2, 1, 9, 12), -7.0, device=device, dtype=dtype)  # between nodes 1 and 2
        expected = render(image, defocus, bank, "occlusion", method=method)
        bank.psfs[[0, 3, 4, 5]] = float("nan")
        assert torch.equal(render(image, defocus, bank, "occlusion", method=method), expected)

    def test_feature_one_defocus_map_serves_all_images(self, device, dtype):
        bank = make_bank(dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, batch=3)
        together = render_by(SMALL_TILES, image, defocus[:1], bank, "occlusion")
        for b in range(3):
            alone = render_by(SMALL_TILES, image[b : b + 1], defocus[:1], bank, "occlusion")
            self.assert_close(together[b : b + 1], alone, rtol=0, atol=1e-6 if dtype == torch.float32 else 1e-13)

    def test_exception_names_the_shape_that_does_not_fit(self):
        shapes = {"image": (2, 3, 9, 12), "defocus": (2, 1, 9, 11), "nodes": (4,), "psfs": (4, 3, 5, 5)}
        with pytest.raises(ValueError, match=re.escape("shape (2, 1, 9, 12) or (1, 1, 9, 12), got (2, 1, 9, 11)")):
            occlusion(**{name: torch.zeros(shape) for name, shape in shapes.items()})

    def test_dynamo_compiles_to_the_dense_render(self, device):
        bank = make_bank(3, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 8, 9)
        function = torch.compile(lambda i, d: render(i, d, bank, "occlusion"), backend="eager", fullgraph=True)
        expected = render(image, defocus, bank, "occlusion", method="dense")
        self.assert_close(function(image, defocus), expected, rtol=0, atol=1e-12)


class TestBatchedOcclusion(RenderTester):
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, layers, border, device, dtype):
        for batch, channels, size, height, width in ((2, 3, 5, 31, 46), (1, 1, 7, 64, 33), (3, 2, 1, 17, 40)):
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            for psi in (defocus, steps(bank, height, width), steps(bank, height, width, 30)):
                self.assert_equals_dense(SMALL_TILES, image, psi, bank, "occlusion", ATOL[dtype], **options)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_equals_the_dense_render_of_hard_scenes(self, layers, kind, device, dtype):
        bank = make_bank(6, 2, 5, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 37, 51)
        defocus = depth_map(kind, bank, 37, 51)
        self.assert_equals_dense(SMALL_TILES, image, defocus, bank, "occlusion", ATOL[dtype], layers=layers)

    @given(data=st.data())
    @settings(max_examples=40)
    def test_property_equals_the_dense_render_at_any_size(self, data):
        draw = data.draw
        torch.manual_seed(draw(st.integers(0, 99)))
        radius, border = draw(st.integers(0, 6)), draw(st.sampled_from(BORDERS))
        smallest = {"reflect": radius + 1, "circular": max(radius, 1), "valid": 2 * radius + 1}.get(border, 1)
        height, width = (draw(st.integers(smallest, 90)) for _ in range(2))
        count = draw(st.integers(1, 6))
        bank = make_bank(count, draw(st.sampled_from([1, 3])), 2 * radius + 1, light=0.7, veil=True)
        psfs = bank.psfs + 0.5 / (2 * radius + 1) ** 2  # where a PSF has no light, round-off is divided by epsilon
        bank = Bank(psfs, bank.defocus, bank.veil)
        image, _ = make_scene(bank, draw(st.integers(1, 3)), height, width)
        defocus = steps(bank, height, width, draw(st.integers(1, 60)))
        layers = draw(st.sampled_from(["nearest", "linear"]))
        expected = render(image, defocus, bank, "occlusion", layers=layers, border=border, method="dense")
        coded = render(image, defocus, bank, "occlusion", layers=layers, border=border, method="batched")
        self.assert_close(coded, expected, rtol=0, atol=1e-11)

    @pytest.mark.parametrize("border", ["zero", "replicate"])
    def test_feature_psfs_larger_than_the_image(self, border, device):
        for size, height, width in ((41, 5, 7), (65, 33, 40), (301, 1, 1)):
            bank = make_bank(3, 1, size, device=device)
            image, defocus = make_scene(bank, 2, height, width)
            expected = render(image, defocus, bank, "occlusion", border=border, layers="nearest", method="dense")
            coded = render(image, defocus, bank, "occlusion", border=border, layers="nearest", method="batched")
            self.assert_close(coded, expected, rtol=0, atol=1e-9)

    # Gradients

    @pytest.mark.parametrize("method", [SMALL_TILES, "dense"], ids=["batched", "dense"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_gradcheck(self, method, border, device):
        bank = make_bank(3, 2, 3, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 9, 15)
        middles = torch.tensor([-25.0, -17.0, -8.0, -25.0], device=device, dtype=torch.float64)  # away from the nodes
        y, x = torch.arange(9, device=device)[:, None] // 4, torch.arange(15, device=device) // 7
        defocus = middles[torch.stack([y + x, 2 * y + x]) % 4][:, None]

        def function(image, defocus, psfs, veil):
            return render_by(method, image, defocus, Bank(psfs, bank.defocus, veil), "occlusion", border=border)

        self.gradcheck(function, (image, defocus, bank.psfs, bank.veil))

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    @pytest.mark.parametrize("maps", [1, 2])
    def test_feature_gradients_equal_those_of_the_dense_render(self, layers, border, maps, device, dtype):
        bank = make_bank(5, 2, 5, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 31, 46)
        defocus = steps(bank, 31, 46, 15).expand(maps, -1, -1, -1) + 0.5
        atol = 2e-5 if dtype == torch.float32 else 1e-10
        options = {"layers": layers, "border": border}
        self.assert_gradients_equal_dense(SMALL_TILES, image, defocus, bank, "occlusion", atol, **options)

    @pytest.mark.parametrize("kind", ["tiles of one layer", "depths on the nodes"])
    def test_feature_gradients_of_hard_scenes_equal_those_of_the_dense_render(self, kind, device):
        tiles = SMALL_TILES  # of 12 x 12 pixels: 2 blocks, the last of them beyond the image
        bank = make_bank(4, 1, 5, device=device)
        image, _ = make_scene(bank, 1, 8, 40)
        odd = kind.startswith("tiles")
        defocus = bank.defocus[1].expand(1, 1, 8, 40) if odd else steps(bank, 8, 40, 5)
        gradients = []
        for method in (tiles, "dense"):
            inputs = [x.clone().requires_grad_() for x in (image, defocus, bank.psfs)]
            scene = Bank(inputs[2], bank.defocus)
            coded = render_by(method, *inputs[:2], scene, "occlusion", layers="nearest" if odd else "linear")
            wanted = [inputs[0], inputs[2]] if odd else inputs
            gradients.append(torch.autograd.grad(coded.square().sum(), wanted))
        for gradient, expected in zip(*gradients, strict=True):
            self.assert_close(
                gradient, expected, rtol=0, atol=1e-6 * float(expected.abs().max())
            )  # gradients reach 1 / epsilon

    @pytest.mark.parametrize("wanted", range(4))
    def test_feature_each_gradient_can_be_had_alone(self, wanted, device):
        bank = make_bank(4, 1, 5, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 31, 46)
        inputs = [image, steps(bank, 31, 46, 20) + 0.5, bank.psfs, bank.veil]
        inputs[wanted] = inputs[wanted].clone().requires_grad_()
        gradients = []
        for method in (SMALL_TILES, "dense"):
            coded = render_by(method, *inputs[:2], Bank(inputs[2], bank.defocus, inputs[3]), "occlusion")
            gradients.append(torch.autograd.grad(coded.square().sum(), inputs[wanted])[0])
        self.assert_close(*gradients, rtol=1e-9, atol=1e-11)

    def test_feature_second_gradients_are_those_of_the_dense_render(self, device):
        bank = make_bank(2, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 6, 6)
        found = []
        for method in ("dense", "batched"):
            psfs = bank.psfs.clone().requires_grad_()
            coded = render(image, defocus, Bank(psfs, bank.defocus), "occlusion", method=method)
            gradient = torch.autograd.grad(coded.square().sum(), psfs, create_graph=True)[0].square().sum()
            found.append(torch.autograd.grad(gradient, psfs)[0])
        self.assert_close(found[1], found[0], rtol=1e-4, atol=1e-4 * float(found[0].abs().max()))

    # Memory and numeric types

    def test_feature_no_tensor_is_larger_than_the_image_or_a_chunk(self, device):
        """Of all that is made on the way, forward and backward, with 20 layers in every tile."""
        nodes = torch.linspace(-20, 20, 20, device=device)
        bank = Bank(torch.rand(20, 1, 5, 5, device=device).requires_grad_(), nodes)
        image = torch.rand(1, 1, 128, 128, device=device).requires_grad_()
        defocus = torch.empty(1, 1, 128, 128, device=device).uniform_(-20, 20).requires_grad_()
        largest = LargestTensor()
        with largest:
            render_by(BatchedBackend(chunk_bytes=200_000), image, defocus, bank, "occlusion").sum().backward()
        assert largest.bytes < 4_000_000  # two tiles of 20 layers at least; the planes of all layers are 5 MB and more

    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_feature_half_is_the_dense_render_to_its_last_place(self, half, device):
        bank = make_bank(6, 3, 7, dtype=torch.float32, device=device, light=0.8, veil=True).to(half)
        image, defocus = make_scene(make_bank(6, 3, 7, dtype=torch.float32, device=device), 2, 44, 37)
        coded = render_by(SMALL_TILES, image.to(half), defocus, bank, "occlusion")
        expected = render(image.to(half), defocus, bank, "occlusion", method="dense")
        assert coded.dtype == half
        self.assert_close(coded, expected, rtol=torch.finfo(half).eps, atol=1e-6)
