"""Direct convolution against the dense renderer, and the choice between it and transforms."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.kernels import gather_ops
from kornia_tidy.kernels.build import compiled
from kornia_tidy.render.backends.direct import SOURCE, count_pairs
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import render
from kornia_tidy.render.dispatch import BACKENDS, choose, refusal
from kornia_tidy.render.scene import Labels, layered_scene, scene_of_layers
from tests.base import BaseTester
from tests.render.backends.test_tiled import ATOL, KINDS, depth_map
from tests.render.render_tester import RenderTester
from tests.render.scenes import Bank, brute_render, make_bank, make_scene

pytestmark = pytest.mark.skipif(
    compiled(SOURCE, torch.float32) is None, reason="no C compiler on this machine: all is rendered by transforms"
)


class TestDirectRender(RenderTester):
    @pytest.fixture
    def device(self):
        """Direct convolution is for processors."""
        return torch.device("cpu")

    def test_smoke_a_scene_of_many_blocks(self, device, dtype):
        bank = make_bank(6, 3, 9, dtype=dtype, device=device)
        image, defocus = make_scene(bank, 2, 50, 130)
        coded = render(image, defocus, bank, method="direct")
        assert coded.shape == image.shape
        assert coded.dtype == dtype

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, layers, border, device, dtype):
        """All ways to end a column of a PSF, and blocks that overlap or just fit."""
        for batch, channels, size, height, width in (
            (2, 3, 5, 31, 46),
            (1, 2, 1, 18, 40),
            (1, 2, 3, 18, 40),
            (1, 1, 7, 64, 73),
            (3, 2, 9, 16, 64),
            (1, 1, 11, 37, 50),
        ):
            bank = make_bank(5, channels, size, dtype=dtype, device=device, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            self.assert_equals_dense("direct", image, defocus, bank, "gather", ATOL[dtype], **options)

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_equals_the_dense_render_of_hard_scenes(self, layers, kind, device, dtype):
        bank = make_bank(6, 2, 5, dtype=dtype, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 37, 51)
        defocus = depth_map(kind, bank, 37, 51)
        self.assert_equals_dense("direct", image, defocus, bank, "gather", ATOL[dtype], layers=layers)

    @given(data=st.data())
    @settings(max_examples=40)
    def test_property_equals_the_dense_render_at_any_size(self, data):
        draw = data.draw
        torch.manual_seed(draw(st.integers(0, 99)))
        dtype = draw(st.sampled_from([torch.float32, torch.float64]))
        radius, border = draw(st.integers(0, 9)), draw(st.sampled_from(BORDERS))
        lost = 2 * radius if border == "valid" else 0
        height, width = draw(st.integers(10, 60)) + lost, draw(st.integers(32, 120)) + lost
        bank = make_bank(draw(st.integers(1, 6)), draw(st.sampled_from([1, 3])), 2 * radius + 1, dtype=dtype)
        image, defocus = make_scene(bank, draw(st.integers(1, 3)), height, width)
        options = {"layers": draw(st.sampled_from(["nearest", "linear"])), "border": border}
        self.assert_equals_dense("direct", image, defocus, bank, "gather", ATOL[dtype], **options)

    def test_feature_equals_the_sum_over_pixels(self, device):
        bank = make_bank(4, 1, 5, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 1, 12, 29)
        expected = brute_render(image, defocus, bank, compositing="gather", layers="linear", border="reflect")
        self.assert_close(render(image, defocus, bank, method="direct"), expected, rtol=0, atol=1e-14)

    def test_feature_rows_of_any_stride(self, device):
        """Images and maps that lie in memory otherwise than row by row, and maps that are shared by a batch."""
        bank = make_bank(4, 3, 5, device=device)
        image, defocus = make_scene(bank, 2, 24, 40)
        expected = render(image, defocus[:1], bank, method="direct")
        image = image.to(memory_format=torch.channels_last)
        defocus = defocus.transpose(-2, -1).contiguous().transpose(-2, -1)
        options = {"layers": "linear", "border": "valid"}
        self.assert_close(render(image, defocus[:1], bank, method="direct"), expected, rtol=0, atol=1e-14)
        dense = render(image, defocus, bank, method="dense", **options)
        self.assert_close(render(image, defocus, bank, method="direct", **options), dense, rtol=0, atol=1e-13)

    # Gradients

    @pytest.mark.parametrize("border", BORDERS)
    def test_gradcheck(self, border, device):
        bank = make_bank(3, 2, 5, device=device, light=0.8, veil=True)
        image, _ = make_scene(bank, 2, 9, 23)
        middles = torch.tensor([-25.0, -17.0, -8.0, 3.0], device=device, dtype=torch.float64)  # away from the nodes
        defocus = middles[torch.randint(4, (2, 1, 9, 23), device=device)]

        def function(image, defocus, psfs, veil):
            return render(image, defocus, Bank(psfs, bank.defocus, veil), border=border, method="direct")

        self.gradcheck(function, (image, defocus, bank.psfs, bank.veil))

    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "valid"])
    @pytest.mark.parametrize("size", [3, 5, 9])  # both remainders of rows taken four at a time
    def test_feature_gradients_equal_those_of_the_dense_render(self, layers, border, size, device, dtype):
        bank = make_bank(5, 2, size, dtype=dtype, device=device, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 151, 51)
        atol = 2e-5 if dtype == torch.float32 else 1e-12
        self.assert_gradients_equal_dense("direct", image, defocus, bank, "gather", atol, layers=layers, border=border)

    def test_feature_gradients_on_nodes_are_those_of_the_interval_above(self, device):
        bank = make_bank(4, 1, 5, device=device)
        image, _ = make_scene(bank, 1, 12, 20)
        gradients = []
        for method in ("dense", "direct"):
            defocus = depth_map("checkerboard of all layers", bank, 12, 20).requires_grad_()
            render(image, defocus, bank, method=method).square().sum().backward()
            gradients.append(defocus.grad)
        assert gradients[0].abs().max() > 0
        self.assert_close(*gradients, rtol=1e-10, atol=1e-12)

    def test_feature_equal_on_any_number_of_threads(self, device):
        """Captures to the last bit; gradients of PSFs are summed in as many parts as there are threads."""
        bank = make_bank(4, 3, 7, dtype=torch.float32, device=device)
        image, defocus = make_scene(bank, 2, 150, 90)
        threads, results = torch.get_num_threads(), []
        try:
            for count in (1, 2, 5):
                torch.set_num_threads(count)
                psfs = bank.psfs.clone().requires_grad_()
                coded = render(image, defocus, Bank(psfs, bank.defocus), layers="nearest", method="direct")
                coded.square().sum().backward()
                results.append((coded.detach(), psfs.grad))
        finally:
            torch.set_num_threads(threads)
        for coded, gradient in results[1:]:
            assert torch.equal(coded, results[0][0])
            self.assert_close(gradient, results[0][1], rtol=1e-5, atol=1e-5)

    def test_feature_light_too_dim_for_normal_numbers_stays(self, device):
        """A library built for speed alone would turn denormal numbers off, for the whole process."""
        bank = make_bank(2, 1, 5, dtype=torch.float32, device=device)
        image, defocus = make_scene(bank, 1, 16, 40)
        options = {"layers": "nearest", "method": "direct"}
        dim = render(image * 1e-39, defocus, bank, **options)
        self.assert_close(1e39 * dim.double(), render(image, defocus, bank, **options), rtol=0, atol=1e-4)
        assert torch.tensor(1e-39) * 0.5 > 0


class TestChoice(BaseTester):
    def test_feature_pairs_are_the_layers_that_strips_contain(self):
        """Counted pixel by pixel; 4 rows of strips, so that every fourth of them is the first."""
        lower = torch.randint(5, (1, 4, 1, 64)).expand(1, 4, gather_ops.STRIP_ROWS, 64).reshape(1, 16, 64)
        lower[:, 4:] = lower[:, :4].repeat(1, 3, 1)
        expected = 4 * sum(len(strip.unique()) for strip in lower[0, :4].split(16, dim=1))
        assert count_pairs(Labels(lower, None), torch.float32) == expected
        share = torch.rand(1, 16, 64)
        share[:, :, :16], share[:, :, 16:32] = 0, 1
        both = [lower + (share == 1), lower + (share > 0)]
        expected = 4 * sum(
            len(torch.cat([term[0, :4, left : left + 16].flatten() for term in both]).unique())
            for left in range(0, 64, 16)
        )
        assert count_pairs(Labels(lower, share), torch.float32) == expected

    def test_feature_small_psfs_go_directly_and_large_ones_by_transforms(self):
        psi = torch.arange(8.0)[torch.arange(400) // 50][:, None].expand(1, 1, 400, 600)
        image, sides = torch.rand(1, 1, 400, 600), range(1, 131, 6)
        scenes = {side: layered_scene(image, psi, torch.arange(8.0), torch.rand(8, 1, side, side)) for side in sides}
        direct = [side for side in sides if choose(scenes[side]).name == "direct"]
        assert direct[0] == 1
        assert direct[-1] < 100
        assert direct == list(range(1, direct[-1] + 1, 6))

    @pytest.mark.parametrize(
        ("size", "where", "compositing", "message"),
        [
            ((3, 64), "cpu", "gather", "needs an output of at least 4x32 pixels, got 3x64"),
            ((8, 31), "cpu", "gather", "needs an output of at least 4x32 pixels, got 8x31"),
            ((8, 64), "meta", "gather", "runs on processors, and the image is on 'meta'"),
            ((8, 64), "cpu", "scatter", "gathers light and does not scatter it"),
        ],
    )
    def test_exception_names_why_a_scene_is_refused(self, size, where, compositing, message):
        scene = scene_of_layers(
            torch.zeros(1, 1, *size, device=where),
            torch.zeros(1, 1, *size, device=where, dtype=torch.int64),
            None,
            torch.zeros(1, 1, 3, 3, device=where),
            None,
            "reflect",
            compositing,
            torch.float32,
        )
        assert message in (refusal(BACKENDS["direct"], scene) or "")
        with pytest.raises(ValueError, match=f"method 'direct' does not support this scene: .*{message}"):
            choose(scene, "direct")

    @pytest.mark.takes_seconds
    def test_feature_without_a_compiler_it_is_refused(self, tmp_path):
        """In a process of its own, whose compiler does nothing."""
        code = (
            "import torch, warnings; warnings.simplefilter('ignore')\n"
            "from kornia_tidy.render.dispatch import explain\n"
            "from kornia_tidy.render.scene import layered_scene\n"
            "for compositing in ('gather', 'occlusion'):\n"
            "    scene = layered_scene(torch.rand(1, 1, 40, 40), torch.zeros(1, 1, 40, 40), torch.zeros(1),\n"
            "                          torch.rand(1, 1, 3, 3), compositing=compositing)\n"
            "    print(explain(scene).objections['direct'])\n"
        )
        environment = {**os.environ, "CC": "false", "XDG_CACHE_HOME": str(tmp_path)}
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.count("direct convolution needs a C compiler") == 2
