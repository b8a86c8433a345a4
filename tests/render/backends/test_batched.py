"""The batched backend against the dense one, against models that share no code with either, and within its memory."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_tidy.render.backends import batched
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.layer_sums import present_in_tiles
from kornia_tidy.render.compositing import COMPOSITING, render
from kornia_tidy.render.scene import Labels, layered_scene
from tests.base import BaseTester
from tests.render.render_tester import SMALL_TILES, RenderTester, render_by
from tests.render.scenes import HARD, Bank, hard_depth, make_bank, make_scene, squares
from tests.simulated_device import SimulatedDevice

SUMS = ("gather", "scatter")
over_compositing = pytest.mark.parametrize("compositing", COMPOSITING)


class TestBatchedRender(RenderTester):
    @over_compositing
    @pytest.mark.parametrize("border", ["zero", "replicate"])
    def test_feature_psfs_larger_than_the_image(self, compositing, border, device):
        layers, atol = ("nearest", 1e-9) if compositing == "occlusion" else ("linear", 1e-12)
        for size, height, width in ((41, 5, 7), (65, 33, 40), (301, 1, 1)):
            bank = make_bank(3, 1, size, device=device)
            image, defocus = make_scene(bank, 2, height, width)
            self.assert_equals_dense("batched", image, defocus, bank, compositing, atol, layers=layers, border=border)

    @pytest.mark.parametrize("kind", ["tiles of one layer", "depths on the nodes"])
    def test_gradcheck_occlusion_of_hard_scenes_equals_the_dense_gradients(self, kind, device):
        bank = make_bank(4, 1, 5, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 1, 8, 40)  # 2 blocks of 12 x 12 pixels, the last of them beyond the image
        odd = kind.startswith("tiles")
        defocus = bank.defocus[1].expand(1, 1, 8, 40) if odd else squares(bank, 8, 40, 5)
        layers = "nearest" if odd else "linear"  # gradients reach 1 / epsilon
        self.assert_gradients_equal_dense(SMALL_TILES, image, defocus, bank, "occlusion", 1e-6, layers=layers)

    # Memory

    @pytest.mark.parametrize("compositing", SUMS)
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

    @over_compositing
    def test_feature_no_tensor_is_larger_than_the_image_or_a_chunk(self, compositing, device):
        """Of all that is made on the way, forward and backward, with 20 layers in every tile."""
        side, chunk, most = (128, 200_000, 4_000_000) if compositing == "occlusion" else (256, 600_000, 1_440_000)
        nodes = torch.linspace(-20, 20, 20, device=device)
        bank = Bank(torch.rand(20, 1, 5, 5, device=device).requires_grad_(), nodes)
        image = torch.rand(1, 1, side, side, device=device).requires_grad_()
        defocus = torch.empty(1, 1, side, side, device=device).uniform_(-20, 20).requires_grad_()
        largest = LargestTensor()
        with largest:
            render_by(BatchedBackend(chunk_bytes=chunk), image, defocus, bank, compositing).sum().backward()
        assert largest.bytes < most  # two tiles of 20 layers at least; the planes of all layers are 5 and 10 MB


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


class TestTiles(BaseTester):
    @pytest.mark.parametrize("kind", HARD)
    @pytest.mark.parametrize("reach", [0, 4])
    def test_feature_layers_are_those_that_tiles_or_their_windows_hold(self, kind, reach):
        """Counted pixel by pixel."""
        bank = make_bank(6, 1, 5)
        psi = hard_depth(kind, bank, 37 + reach, 51 + reach)
        label = (psi[0] - bank.defocus.view(-1, 1, 1)).abs().argmin(0)[None].expand(2, -1, -1)
        present = present_in_tiles(Labels(label, None), (12, 14), 6, reach).view(2, 4, 4, 6)
        for b, r, k in product(range(2), range(4), range(4)):
            seen = label[b, r * 12 : (r + 1) * 12 + reach, k * 14 : (k + 1) * 14 + reach]
            assert present[b, r, k].nonzero()[:, 0].tolist() == seen.unique().tolist()

    @over_compositing
    def test_feature_parts_hold_each_pixel_once_and_the_layers_around_it(self, compositing):
        bank = make_bank(6, 3, 5)
        image, defocus = make_scene(bank, 2, 130, 170)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing)
        index, weight = scene.sorted_layers
        assert weight is not None
        reach = 4 if compositing == "occlusion" else 0
        counted = torch.zeros(2, 3, index.shape[-2] - reach, index.shape[-1] - reach)
        for part in BatchedBackend(chunk_bytes=1 << 20).parts(scene):
            counted[part.images, part.channels, part.rows, part.columns] += 1
            held = part.window(index, reach).unique()
            assert part.layers == sorted({*held.tolist(), *(held + 1).tolist()} & {*range(6)})
        assert bool((counted == 1).all())

    def test_feature_tiles_are_no_shorter_than_their_overlap_and_windows_no_larger_than_needed(self):
        for size in (1, 5, 23, 129, 257):
            for height, width in ((1, 1), (40, 2000), (500, 600)):
                bank = make_bank(1, 1, size)
                image, defocus = make_scene(bank, 1, height, width)
                scene = layered_scene(image, defocus, bank.defocus, bank.psfs, border="replicate")
                for side, tile in zip((height, width), BatchedBackend().tile(scene), strict=True):
                    assert -(-side // tile) <= 2 or tile >= size - 1
                    assert tile + size - 1 <= 1.25 * (2 * size + 64)


SCENES = (("reflect", "linear", 1), ("zero", "nearest", 3), ("valid", "linear", 3))  # border, layers, maps
PARTS = ("whole planes", "parts of them", "tiles", "one block")  # two by turns for each scene and compositing


@pytest.fixture
def parts(request, monkeypatch) -> str:
    if request.param in ("one block", "tiles"):
        monkeypatch.setattr(batched, "MOST_SAMPLES", 0)
    if request.param in ("parts of them", "tiles"):
        monkeypatch.setattr(batched, "PART_BYTES", 20_000)
    return request.param


class TestOnAnAccelerator(BaseTester):
    """There all layers are convolved, of whole planes or of tiles, and no value is looked at."""

    @pytest.mark.parametrize(
        ("compositing", "border", "layers", "maps", "parts"),
        [
            (compositing, *scene, parts)
            for number, (compositing, scene) in enumerate(product(COMPOSITING, SCENES))
            for parts in PARTS[number % 2 :: 2]
        ],
        indirect=["parts"],
    )
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
