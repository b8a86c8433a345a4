"""The batched backend against the dense one, against models that share no code with either, and within its memory."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_tidy.render.backends import batched
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.tiles import Grid, plan_pairs
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import render
from kornia_tidy.render.scene import Labels, layered_scene
from tests.base import BaseTester
from tests.render.render_tester import SMALL_TILES, RenderTester, render_by
from tests.render.scenes import Bank, brute_render, make_bank, make_scene
from tests.simulated_device import SimulatedDevice

COMPOSITINGS = ("gather", "scatter")
ATOL = {torch.float32: 2e-6, torch.float64: 1e-12}


def depth_map(kind, bank, height, width):
    """Scenes that are hard on tiles."""
    like = {"dtype": bank.psfs.dtype, "device": bank.psfs.device}
    nodes = bank.defocus
    y, x = torch.arange(height, device=like["device"])[:, None], torch.arange(width, device=like["device"])
    if kind == "checkerboard of all layers":
        return nodes[(y + x) % len(nodes)][None, None]
    if kind == "half way between layers":
        return ((nodes[1:] + nodes[:-1]) / 2)[(y // 3 + x) % (len(nodes) - 1)][None, None]
    flat = torch.full((1, 1, height, width), float(nodes[1]), **like)
    if kind == "one pixel of another layer":
        flat[..., height // 2, width // 3] = nodes[-1]
    if kind == "a ramp":
        flat[:] = nodes[0] + (nodes[-1] - nodes[0]) * (x / max(width - 1, 1)).to(nodes.dtype)
    return flat


KINDS = (
    "checkerboard of all layers",
    "half way between layers",
    "constant",
    "one pixel of another layer",
    "a ramp",
)


class TestBatchedRender(RenderTester):
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_smoke_a_scene_of_many_tiles(self, compositing, device, dtype):
        bank = make_bank(6, 3, 9, dtype=dtype, device=device)
        image, defocus = make_scene(bank, 2, 150, 230)
        coded = render(image, defocus, bank, compositing, method="batched")
        assert coded.shape == image.shape
        assert coded.dtype == dtype

    # Equal to the dense renderer

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, compositing, layers, border, device, dtype):
        for batch, channels, size, height, width in ((2, 3, 5, 31, 46), (1, 1, 7, 64, 33), (3, 2, 1, 17, 40)):
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            self.assert_equals_dense(SMALL_TILES, image, defocus, bank, compositing, ATOL[dtype], **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_equals_the_dense_render_of_hard_scenes(self, compositing, layers, kind, device, dtype):
        bank = make_bank(6, 2, 5, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 37, 51)
        defocus = depth_map(kind, bank, 37, 51)
        self.assert_equals_dense(SMALL_TILES, image, defocus, bank, compositing, ATOL[dtype], layers=layers)

    @given(data=st.data())
    @settings(max_examples=60)
    def test_property_equals_the_dense_render_at_any_size(self, data):
        draw = data.draw
        torch.manual_seed(draw(st.integers(0, 99)))
        radius, border = draw(st.integers(0, 9)), draw(st.sampled_from(BORDERS))
        smallest = {"reflect": radius + 1, "circular": max(radius, 1), "valid": 2 * radius + 1}.get(border, 1)
        height, width = (draw(st.integers(smallest, 90)) for _ in range(2))
        count = draw(st.integers(1, 6))
        bank = make_bank(count, draw(st.sampled_from([1, 3])), 2 * radius + 1, light=0.7, veil=True)
        image, defocus = make_scene(bank, draw(st.integers(1, 3)), height, width)
        kind = draw(st.sampled_from(["random", "one for all", *(KINDS if count > 1 else ())]))
        if kind != "random":
            defocus = defocus[:1] if kind == "one for all" else depth_map(kind, bank, height, width)
        compositing, layers = draw(st.sampled_from(COMPOSITINGS)), draw(st.sampled_from(["nearest", "linear"]))
        expected = render(image, defocus, bank, compositing, layers=layers, border=border, method="dense")
        coded = render(image, defocus, bank, compositing, layers=layers, border=border, method="batched")
        self.assert_close(coded, expected, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("border", ["zero", "replicate"])
    def test_feature_psfs_larger_than_the_image(self, compositing, border, device):
        for size, height, width in ((41, 5, 7), (65, 33, 40), (301, 1, 1)):
            bank = make_bank(3, 1, size, device=device)
            image, defocus = make_scene(bank, 2, height, width)
            expected = render(image, defocus, bank, compositing, border=border, method="dense")
            coded = render(image, defocus, bank, compositing, border=border, method="batched")
            self.assert_close(coded, expected, rtol=0, atol=1e-12)

    # Equal to sums over pixels, which share no code with either renderer

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_sum_over_pixels(self, compositing, border, device):
        bank = make_bank(4, 1, 3, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 1, 20, 29)  # several blocks of 6 x 12 pixels
        expected = brute_render(image, defocus, bank, compositing=compositing, layers="linear", border=border)
        coded = render_by(SMALL_TILES, image, defocus, bank, compositing, border=border)
        self.assert_close(coded, expected, rtol=0, atol=1e-14)

    # Gradients

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("border", BORDERS)
    def test_gradcheck(self, compositing, border, device):
        bank = make_bank(3, 2, 3, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 9, 15)
        middles = torch.tensor([-25.0, -17.0, -8.0, 3.0], device=device, dtype=torch.float64)  # away from the nodes
        defocus = middles[torch.randint(4, (2, 1, 9, 15), device=device)]

        def function(image, defocus, psfs, veil):
            scene = Bank(psfs, bank.defocus, veil)
            return render_by(SMALL_TILES, image, defocus, scene, compositing, border=border)

        self.gradcheck(function, (image, defocus, bank.psfs, bank.veil))

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "valid"])
    @pytest.mark.parametrize("maps", [1, 2])
    def test_feature_gradients_equal_those_of_the_dense_render(self, compositing, layers, border, maps, device, dtype):
        bank = make_bank(5, 2, 5, dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 31, 46)
        atol = 2e-5 if dtype == torch.float32 else 1e-12
        options = {"layers": layers, "border": border}
        self.assert_gradients_equal_dense(SMALL_TILES, image, defocus[:maps], bank, compositing, atol, **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("wanted", range(3))
    def test_feature_each_gradient_can_be_had_alone(self, compositing, wanted, device):
        bank = make_bank(4, 1, 5, device=device)
        image, defocus = make_scene(bank, 2, 31, 46)
        inputs = [image, defocus, bank.psfs]
        inputs[wanted] = inputs[wanted].clone().requires_grad_()
        gradients = []
        for method in (SMALL_TILES, "dense"):
            coded = render_by(method, *inputs[:2], Bank(inputs[2], bank.defocus), compositing)
            gradients.append(torch.autograd.grad(coded.square().sum(), inputs[wanted])[0])
        self.assert_close(*gradients, rtol=1e-10, atol=1e-12)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_second_gradients_are_those_of_the_dense_render(self, compositing, device):
        bank = make_bank(2, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 6, 6)
        found = []
        for method in ("dense", "batched"):
            psfs = bank.psfs.clone().requires_grad_()
            coded = render(image, defocus, Bank(psfs, bank.defocus), compositing, method=method)
            second = torch.autograd.grad(coded.square().sum(), psfs, create_graph=True)[0].square().sum()
            found.append(torch.autograd.grad(second, psfs)[0])
        self.assert_close(found[1], found[0], rtol=1e-4, atol=1e-4 * float(found[0].abs().max()))

    # Memory

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    def test_feature_what_is_kept_for_gradients_does_not_grow_with_the_layers(self, compositing, layers, device):
        """Beyond the PSFs themselves: a blurred image, spectrum or mask a layer would be at least 2 kB a layer."""

        def kept_bytes(count):
            nodes = torch.linspace(-20, 20, count, device=device)
            bank = Bank(torch.rand(count, 1, 5, 5, device=device).requires_grad_(), nodes)
            image = torch.rand(1, 1, 64, 64, device=device).requires_grad_()
            defocus = torch.empty(1, 1, 64, 64, device=device).uniform_(-20, 20).requires_grad_()
            kept = {}

            def pack(tensor):
                kept[tensor.untyped_storage().data_ptr()] = (tensor.untyped_storage().nbytes(), tensor)
                return tensor

            with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
                coded = render(image, defocus, bank, compositing, layers=layers, method="batched")
            assert coded.requires_grad
            return sum(size for size, _ in kept.values())

        hanging = 2 * 64 * 64 * 4  # other tiles may hang over the image by less than themselves
        assert kept_bytes(42) - kept_bytes(2) <= 40 * (5 * 5 * 4 + 3 * 8) + hanging

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_no_tensor_is_larger_than_the_image_or_a_chunk(self, compositing, device):
        """Of all that is made on the way, forward and backward, with 20 layers in every tile."""
        nodes = torch.linspace(-20, 20, 20, device=device)
        bank = Bank(torch.rand(20, 1, 5, 5, device=device).requires_grad_(), nodes)
        image = torch.rand(1, 1, 256, 256, device=device).requires_grad_()
        defocus = torch.empty(1, 1, 256, 256, device=device).uniform_(-20, 20)
        largest = LargestTensor()
        with largest:
            render_by(BatchedBackend(chunk_bytes=600_000), image, defocus, bank, compositing).sum().backward()
        assert largest.bytes < 2 * 300 * 300 * 8  # int64 labels of the padded plane; all layers' planes are 10 MB

    # Numeric types

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_feature_half_is_the_dense_render_to_its_last_place(self, compositing, half, device):
        bank = make_bank(6, 3, 7, dtype=torch.float32, device=device, light=0.8, veil=True).to(half)
        image, defocus = make_scene(make_bank(6, 3, 7, dtype=torch.float32, device=device), 2, 44, 37)
        coded = render_by(SMALL_TILES, image.to(half), defocus, bank, compositing)
        expected = render(image.to(half), defocus, bank, compositing, method="dense")
        assert coded.dtype == half
        self.assert_close(coded, expected, rtol=torch.finfo(half).eps, atol=1e-6)

    def test_feature_occlusion_hides_what_is_behind_an_opaque_layer(self):
        """Where the nearest layer is all there is, nothing shines through, and nothing behind has a gradient."""
        bank = make_bank(layers=3, channels=1, size=3)
        image, defocus = torch.rand(1, 1, 8, 8, dtype=torch.float64), torch.full((1, 1, 8, 8), -4.0).double()
        psfs = bank.psfs.clone().requires_grad_()
        coded = render_by("batched", image, defocus, Bank(psfs, bank.defocus), "occlusion")
        coded.sum().backward()
        assert psfs.grad is not None
        assert float(psfs.grad[:2].abs().max()) <= 1e-9
        assert float(psfs.grad[2].abs().max()) > 1e-3

    def test_exception_torch_func_takes_dense_alone(self):
        bank = make_bank()
        image, defocus = make_scene(bank)
        with pytest.raises(ValueError, match=r"method 'batched' does not support this scene: torch\.func"):
            torch.func.grad(lambda x: render_by("batched", x, defocus, bank).sum())(image)


class LargestTensor(TorchDispatchMode):
    """Remembers the size of the largest tensor that any operation returned, views left out."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for x in out if isinstance(out, (tuple, list)) else (out,):
            if isinstance(x, torch.Tensor):
                self.bytes = max(self.bytes, x.untyped_storage().nbytes())
        return out


class TestPlan(BaseTester):
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("windowed", [False, True])
    def test_feature_pairs_are_the_layers_that_blocks_or_their_windows_contain(self, kind, windowed):
        """Counted pixel by pixel."""
        bank, lost = make_bank(6, 1, 5), 4 if windowed else 0
        psi = depth_map(kind, bank, 37 + lost, 51 + lost)
        label = (psi[0] - bank.defocus.view(-1, 1, 1)).abs().argmin(0)[None].expand(2, -1, -1)
        grid = Grid(2, (37, 51), 4, (16, 16), 2, windowed)
        plan, (down, across) = plan_pairs(grid, Labels(label, None), 6, limit=9), grid.tile
        found, numbers = {}, []
        for chunk in plan.chunks:
            assert len(chunk.layer) <= 9 or chunk.extent == (1, 1, 1)
            corner = chunk.pixels[0].start, chunk.pixels[1].start // down, chunk.pixels[2].start // (2 * across)
            for pair, (block, layer) in enumerate(
                zip(chunk.block.tolist(), plan.layers[chunk.layer].tolist(), strict=True)
            ):
                place = [int(n) for n in torch.unravel_index(torch.tensor(block), chunk.extent)]
                key = tuple(start + n for start, n in zip(corner, place, strict=True))
                found.setdefault(key, []).append(layer)
                flat = (key[0] * grid.rows + key[1]) * grid.columns + key[2]
                assert plan.number[flat, layer] == chunk.first + pair
            numbers += [pair + chunk.first for _, own, _ in chunk.runs for pair in range(own.start, own.stop)]
        assert numbers == list(range(sum(map(len, found.values()))))
        for b, r, k in product(range(2), range(grid.rows), range(grid.columns)):
            seen = label[b, r * down : (r + 1) * down + lost, k * 2 * across : (k + 1) * 2 * across + lost]
            assert found[b, r, k] == seen.unique().tolist()

    def test_feature_tiles_are_no_shorter_than_their_overlap_and_windows_no_larger_than_needed(self):
        for size in (1, 5, 23, 129, 257):
            for height, width in ((1, 1), (40, 2000), (500, 600)):
                bank = make_bank(1, 1, size)
                image, defocus = make_scene(bank, 1, height, width)
                scene = layered_scene(image, defocus, bank.defocus, bank.psfs, border="replicate")
                grid = BatchedBackend().grid(scene)
                assert grid.shape == (height, width)
                assert grid.rows <= 2 or grid.tile[0] >= size - 1
                assert grid.columns <= 2 or 2 * grid.tile[1] >= size - 1
                assert max(grid.size) <= max(64, 1.25 * 2.5 * size + 16)


@pytest.fixture(params=["whole planes", "parts of them", "one block", "tiles"])
def parts(request, monkeypatch) -> str:
    if request.param in ("one block", "tiles"):
        monkeypatch.setattr(batched, "MOST_SAMPLES", 0)
    if request.param in ("parts of them", "tiles"):
        monkeypatch.setattr(batched, "PART_BYTES", 20_000)
    return request.param


class TestOnAnAccelerator(BaseTester):
    """There all layers are convolved, of whole planes or of tiles, and no value is looked at."""

    @pytest.mark.parametrize("layers", ["linear", "nearest"])
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    @pytest.mark.parametrize("compositing", [*COMPOSITINGS, "occlusion"])
    @pytest.mark.parametrize("maps", [1, 3])
    def test_gradcheck_equals_dense_without_a_wait(self, compositing, border, layers, maps, parts):
        bank = make_bank(light=0.9, veil=True)
        image, defocus = make_scene(bank, batch=3)
        inputs = image, defocus[:maps], bank.psfs, bank.veil

        def rendered(method, inputs, nodes):
            leaves = [x.detach().requires_grad_() for x in inputs]
            scene = Bank(leaves[2], nodes, leaves[3])
            coded = render(leaves[0], leaves[1], scene, compositing, layers=layers, border=border, method=method)
            found = torch.autograd.grad(coded.square().mean(), leaves, allow_unused=True)
            return [coded.detach(), *found]

        expected = rendered("dense", inputs, bank.defocus)
        with SimulatedDevice() as device:
            given, nodes = [device.put(x) for x in inputs], device.put(bank.defocus)
            device.reset()
            found = rendered("batched", given, nodes)
            assert device.waits <= 2  # for the nodes, which are checked
            found = [None if x is None else x.cpu() for x in found]
        # Round-off is some 1e-16 of the light; occlusion divides it by as little as 1e-6.
        atol = 1e-8 if compositing == "occlusion" else 1e-12
        for own, dense in zip(found, expected, strict=True):
            assert (own is None) == (dense is None)
            if dense is not None:
                self.assert_close(own, dense, rtol=0, atol=atol * max(1.0, float(dense.abs().max())))
