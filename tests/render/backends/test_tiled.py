"""The tiled renderer against the dense one, against models that share no code with either, and within its memory."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_tidy.render.backends.block_plan import plan_blocks
from kornia_tidy.render.backends.tile_plan import BLOCKS, WINDOWS, tile_grid
from kornia_tidy.render.backends.tile_workspace import TileWorkspace
from kornia_tidy.render.backends.tiled import TiledBackend
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import render
from kornia_tidy.render.scene import Labels, layered_scene
from tests.base import BaseTester
from tests.render.render_tester import SMALL_TILES, RenderTester, render_by
from tests.render.scenes import Bank, brute_render, make_bank, make_scene

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


class TestTiledRender(RenderTester):
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_smoke_a_scene_of_many_tiles(self, compositing, device, dtype):
        bank = make_bank(6, 3, 9, dtype=dtype, device=device)
        image, defocus = make_scene(bank, 2, 150, 230)
        coded = render(image, defocus, bank, compositing, method="tiled")
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
        coded = render(image, defocus, bank, compositing, layers=layers, border=border, method="tiled")
        self.assert_close(coded, expected, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("border", ["zero", "replicate"])
    def test_feature_psfs_larger_than_the_image(self, compositing, border, device):
        for size, height, width in ((41, 5, 7), (65, 33, 40), (301, 1, 1)):
            bank = make_bank(3, 1, size, device=device)
            image, defocus = make_scene(bank, 2, height, width)
            expected = render(image, defocus, bank, compositing, border=border, method="dense")
            coded = render(image, defocus, bank, compositing, border=border, method="tiled")
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

    def test_feature_products_by_slices_and_of_all_pairs_are_equal(self, device):
        """A processor multiplies run by run, an accelerator all pairs of a chunk at once."""
        bank = make_bank(5, 2, 5, device=device)
        image, defocus = make_scene(bank, 2, 31, 46)
        labels = layered_scene(image, defocus, bank.defocus, bank.psfs).labels
        grid = tile_grid(tuple(labels.layer_index.shape), 5, SMALL_TILES.blocks)
        plan = plan_blocks(labels, 5, grid, SMALL_TILES.blocks, offset=4)
        plane = torch.nn.functional.pad(image, (2, 2, 2, 2))
        results = []
        for by_slices in (True, False):
            work = TileWorkspace(replace(plan, by_slices=by_slices), bank.psfs)
            sums, found = work.no_spectra(), []
            for chunk, c in product(plan.chunks, range(2)):
                light = torch.fft.fft2(work.windows(plane[:, c], chunk))
                pairs = work.blur(light, work.spectra[c], chunk)
                work.correlate(sums[c], light, pairs, chunk)
                found += [pairs.clone(), work.sum_layers(pairs.clone(), work.conjugate[c], chunk).clone()]
            results.append([*found, work.psfs_of(sums)])
        for one, other in zip(*results, strict=True):
            self.assert_close(one, other, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_second_gradients_are_those_of_the_dense_render(self, compositing, device):
        bank = make_bank(2, 1, 3, device=device)
        image, defocus = make_scene(bank, 1, 6, 6)
        found = []
        for method in ("dense", "tiled"):
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
                coded = render(image, defocus, bank, compositing, layers=layers, method="tiled")
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
        blocks = replace(BLOCKS, chunk_bytes=200_000, accelerator_bytes=200_000)
        with largest:
            render_by(TiledBackend(blocks), image, defocus, bank, compositing).sum().backward()
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
    def test_feature_pairs_are_the_layers_that_tiles_contain(self, kind, device):
        """Counted pixel by pixel."""
        bank = make_bank(6, 1, 5, device=device)
        psi = depth_map(kind, bank, 37, 51)
        label = (psi[0] - bank.defocus.view(-1, 1, 1)).abs().argmin(0)[None].expand(2, -1, -1)
        labels = Labels.of(label, None)
        grid = tile_grid(tuple(labels.layer_index.shape), 5, SMALL_TILES.blocks)
        plan = plan_blocks(labels, 6, grid, SMALL_TILES.blocks, offset=4)
        tile = plan.grid.tile
        expected = {
            (b, y // tile, x // (2 * tile), int(label[b, y, x])) for b in range(2) for y in range(37) for x in range(51)
        }
        columns, rows = plan.grid.columns, plan.grid.rows
        found = []
        for chunk in plan.chunks:
            first = (chunk.batch.start * rows + chunk.rows.start) * columns + chunk.columns.start
            assert chunk.block.bincount(minlength=len(chunk.counts)).tolist() == chunk.counts
            for block, layer in zip(chunk.block.tolist(), chunk.layer.tolist(), strict=True):
                image, rest = divmod(first + block, rows * columns)
                found.append((image, *divmod(rest, columns), int(plan.present[layer])))
        assert len(found) == len(set(found))
        assert set(found) == expected

    @pytest.mark.parametrize("kind", [BLOCKS, WINDOWS])
    def test_feature_tiles_are_no_shorter_than_their_overlap_and_windows_no_larger_than_needed(self, kind):
        for psf_size in (1, 5, 23, 129, 513):
            for height, width in ((1, 1), (40, 2000), (500, 600)):
                shape = (1, height + psf_size - 1, width + psf_size - 1) if kind.windowed else (1, height, width)
                grid = tile_grid(shape, psf_size, kind)
                assert (grid.height, grid.width) == (height, width)
                assert grid.blocks == 1 or grid.size - psf_size + 1 >= psf_size - 1
                assert grid.size <= max(48, 1.5 * max(2.5 * psf_size, 2 * psf_size - 1))

    def test_property_sizes_transform_fast(self):
        assert all((2 * 3) ** 16 * 5**2 * 7 % size == 0 for size in BLOCKS.sizes + WINDOWS.sizes)
