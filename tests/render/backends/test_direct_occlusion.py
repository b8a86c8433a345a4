"""Occlusion by direct convolution against the dense render, however labels lie, and when it is chosen."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.occlusion_ops import occlusion_direct
from kornia_tidy.render.backends.direct_occlusion import SOURCE, can_go_directly
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import occlusion, render
from kornia_tidy.render.dispatch import choose
from kornia_tidy.render.layers import assign_layers
from kornia_tidy.render.scene import layered_scene
from tests.render.render_tester import RenderTester
from tests.render.scenes import Bank, make_bank, make_scene

ATOL = {torch.float32: 2e-5, torch.float64: 1e-12}

needs_compiler = pytest.mark.skipif(compiled(SOURCE, torch.float32) is None, reason="no C compiler compiles it here")


@pytest.fixture(autouse=True)
def _on_a_processor(device):
    if torch.device(device).type != "cpu":
        pytest.skip("direct convolution is for processors")


def label_map(kind: str, bank: Bank, height: int, width: int) -> torch.Tensor:
    """Defocus at, or in the linear case between, the bank's nodes."""
    y, x = torch.arange(height)[:, None], torch.arange(width)
    count = len(bank.defocus)
    label = {
        "one layer": torch.full((height, width), 2),
        "checkerboard": (y * 3 + x) % count,
        "ramp": (x * count // width).expand(height, width),
        "steep ramp": ((y + 2 * x) * count // (height + 2 * width)),
        "squares": (y // 11 * 3 + x // 13 * 5) % count,
        "speck": 1 + 3 * ((y == height // 2) & (x == width // 3)).long(),
        "noise": torch.randint(count, (height, width)),
        "columns": (x % 2 * 3).expand(height, width),
    }[kind]
    psi = bank.defocus[label][None, None]
    # Between the nodes in one half, on them in the other: pixels of two layers beside those of one.
    return psi + torch.where(x < width // 2, 1.5 * torch.rand(height, width), 0).to(psi)


KINDS = ("one layer", "checkerboard", "ramp", "steep ramp", "squares", "speck", "noise", "columns")


@needs_compiler
class TestDirectOcclusion(RenderTester):
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, layers, border, device, dtype):
        for batch, channels, size, height, width in (
            (2, 3, 7, 31, 46),
            (1, 1, 9, 61, 101),
            (3, 2, 15, 30, 55),
            (1, 1, 5, 15, 39),
        ):
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            for psi in (defocus, defocus[:1], label_map("squares", bank, height, width)):
                self.assert_equals_dense("direct", image, psi, bank, "occlusion", ATOL[dtype], **options)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_equals_the_dense_render_however_labels_lie(self, layers, border, kind, device, dtype):
        bank = make_bank(6, 2, 11, dtype=dtype, device=device)
        image, _ = make_scene(bank, 1, 45, 83)
        psi = label_map(kind, bank, 45, 83)
        options = {"layers": layers, "border": border}
        self.assert_equals_dense("direct", image, psi, bank, "occlusion", ATOL[dtype], **options)

    @given(data=st.data())
    @settings(max_examples=40)
    def test_property_equals_the_dense_render_at_any_size(self, data):
        draw = data.draw
        torch.manual_seed(draw(st.integers(0, 99)))
        radius, border = draw(st.integers(0, 9)), draw(st.sampled_from(BORDERS))
        lost = 2 * radius if border == "valid" else 0
        height, width = draw(st.integers(10, 50)) + lost, draw(st.integers(16, 90)) + lost
        bank = make_bank(draw(st.integers(5, 6)), draw(st.sampled_from([1, 3])), 2 * radius + 1, light=0.7, veil=True)
        image, _ = make_scene(bank, draw(st.integers(1, 2)), height, width)
        psi = label_map(draw(st.sampled_from(KINDS)), bank, height, width)
        options = {"layers": draw(st.sampled_from(["nearest", "linear"])), "border": border}
        expected = render(image, psi, bank, "occlusion", method="dense", **options)
        coded = render(image, psi, bank, "occlusion", method="direct", **options)
        self.assert_close(coded, expected, rtol=0, atol=1e-11)

    def test_feature_float32_is_float64_where_divisors_vanish(self, device):
        """PSFs with tails of 1e-9, by which layers are hardly seen."""
        psfs = torch.rand(6, 1, 15, 15, device=device, dtype=torch.float64) ** 12
        bank = Bank(psfs / psfs.sum((-2, -1), keepdim=True), make_bank(6, device=device).defocus)
        single = Bank(bank.psfs.float(), bank.defocus.float())
        image, _ = make_scene(bank, 1, 70, 80)
        for kind in ("squares", "steep ramp", "speck"):
            defocus = label_map(kind, bank, 70, 80).float()
            for layers in ("nearest", "linear"):
                expected = render(image, defocus.double(), bank, "occlusion", layers=layers, method="dense")
                coded = render(image.float(), defocus, single, "occlusion", layers=layers, method="direct")
                self.assert_close(coded.double(), expected, rtol=0, atol=2e-5)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    def test_feature_threads_change_nothing(self, layers, device, dtype):
        bank = make_bank(6, 3, 9, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 91, 77)
        psi = label_map("squares", bank, 91, 77)
        before, coded = torch.get_num_threads(), []
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                coded.append(render(image, psi, bank, "occlusion", layers=layers, method="direct"))
        finally:
            torch.set_num_threads(before)
        assert torch.equal(coded[0], coded[1])
        assert torch.equal(coded[0], coded[2])

    def test_feature_absent_layers_are_not_looked_at(self, device, dtype):
        bank = make_bank(6, 1, 7, dtype=dtype, device=device)
        image, _ = make_scene(bank, 1, 20, 70)
        defocus = torch.full((1, 1, 20, 70), -7.0, device=device, dtype=dtype)  # between nodes 1 and 2
        defocus[..., 40:] = bank.defocus[1]
        expected = render(image, defocus, bank, "occlusion", method="direct")
        bank.psfs[[0, 3, 4, 5]] = float("nan")
        assert torch.equal(render(image, defocus, bank, "occlusion", method="direct"), expected)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    @pytest.mark.parametrize("maps", [1, 2])
    def test_feature_gradients_equal_those_of_the_dense_render(self, layers, border, maps, device, dtype):
        bank = make_bank(5, 2, 7, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 31, 46)
        defocus = (label_map("squares", bank, 31, 46) + 0.5).expand(maps, -1, -1, -1)
        atol = 2e-5 if dtype == torch.float32 else 1e-10
        options = {"layers": layers, "border": border}
        self.assert_gradients_equal_dense("direct", image, defocus, bank, "occlusion", atol, **options)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero", "valid"])
    def test_feature_gradients_of_psfs_alone_equal_those_of_the_dense_render(self, layers, border, device, dtype):
        """And of stray light. They go another way than with those of image and depth, and make no tiles."""
        bank = make_bank(5, 2, 7, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 31, 46)
        defocus = label_map("squares", bank, 31, 46) + 0.5
        gradients = []
        for method in ("dense", "direct"):
            leaves = bank.psfs.clone().requires_grad_(), bank.veil.clone().requires_grad_()
            scene = image, defocus, bank.defocus, *leaves
            coded = occlusion(*scene, layers=layers, border=border, method=method)
            gradients.append(torch.autograd.grad(coded.square().mean(), leaves))
        for expected, found in zip(*gradients, strict=True):
            atol = (2e-5 if dtype == torch.float32 else 1e-10) * float(expected.abs().max())
            self.assert_close(found, expected, rtol=0, atol=atol)

    # When it is chosen

    def test_feature_it_is_chosen_for_small_psfs(self, device):
        image = torch.rand(1, 3, 200, 240, device=device)
        for side, expected in ((11, True), (101, False)):
            bank = make_bank(6, 3, side, dtype=torch.float32, device=device)
            options = {"layers": "nearest", "compositing": "occlusion"}
            scene = layered_scene(image, torch.zeros_like(image[:, :1]), bank.defocus, bank.psfs, **options)
            assert (choose(scene).name == "direct") == expected

    @pytest.mark.parametrize(
        ("size", "below_zero", "message"),
        [
            ((7, 64), 0, "needs an output of at least 8x32 pixels, got 7x64"),
            ((40, 31), 0, "needs an output of at least 8x32 pixels, got 40x31"),
            ((40, 64), 0.001, "needs PSFs without negative values, got one with -.* of its light below zero"),
        ],
    )
    def test_exception_names_why_a_scene_is_refused(self, size, below_zero, message, device):
        image, bank = torch.rand(1, 3, *size, device=device), make_bank(size=7, dtype=torch.float32)
        options = {"compositing": "occlusion", "border": "replicate"}
        bank.psfs[0] -= below_zero
        bank.psfs[0, :, 0] -= 5 * below_zero
        scene = layered_scene(image, torch.zeros_like(image[:, :1]), bank.defocus, bank.psfs, **options)
        with pytest.raises(ValueError, match=f"method 'direct' does not support this scene: .*{message}"):
            choose(scene, "direct")
        assert choose(scene).name != "direct"

    def test_feature_psfs_a_little_below_zero_change_nothing(self, device):
        """As interpolation and round-off leave them."""
        bank = make_bank(6, 1, 11, device=device)
        psfs = bank.psfs.clone()
        psfs[..., :3, :] = -1e-6 * torch.rand(6, 1, 3, 11, device=device)
        image, _ = make_scene(bank, 1, 45, 83)
        defocus = label_map("squares", bank, 45, 83)
        expected = render(image, defocus, Bank(psfs, bank.defocus), "occlusion", layers="nearest", method="dense")
        lower, _ = assign_layers(defocus, bank.defocus, "nearest")
        planes = [torch.nn.functional.pad(x.float(), (5,) * 4, mode="reflect") for x in (image, lower)]
        assert can_go_directly(planes[0], psfs.float())
        coded = occlusion_direct(planes[0], psfs.float(), planes[1][:, 0], None, None, None, None)
        self.assert_close(coded.double(), expected, rtol=0, atol=2e-5)

    @pytest.mark.parametrize("layer", [-(2.0**63), -1.0, 3.0, float("nan")])
    @pytest.mark.parametrize("shared", [False, True])
    def test_feature_a_pixel_in_no_layer_is_dark_and_no_crash(self, layer, shared, device):
        """What a depth that is not a number may come to."""
        lower = torch.ones(1, 40, 60, device=device)
        lower[0, 20, 30] = layer
        fraction = torch.full((1, 40, 60), 0.5, device=device) if shared else None
        light, psfs = torch.rand(1, 1, 40, 60, device=device), torch.rand(3, 1, 7, 7, device=device)
        inside = torch.ones(1, 40, 60, device=device)
        inside[0, 20, 30] = 0
        coded = occlusion_direct(light, psfs, lower, fraction, None, None, None)
        expected = occlusion_direct(light, psfs, torch.ones_like(lower), fraction, None, None, inside)
        self.assert_close(coded, expected, rtol=0, atol=1e-6)
