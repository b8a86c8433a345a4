"""Overlapping windows against the dense render, however labels lie, and when they are chosen."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.overlap_ops import SOURCE
from kornia_tidy.kernels.window_sides import is_window_size
from kornia_tidy.render.backends.overlap import window_size
from kornia_tidy.render.backends.tile_plan import OVERLAPS, candidates
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.dispatch import BACKENDS, choose, explain, refusal
from kornia_tidy.render.scene import layered_scene
from tests.render.backends.test_tiled import ATOL, COMPOSITINGS, KINDS, depth_map
from tests.render.render_tester import RenderTester
from tests.render.scenes import make_bank, make_scene

needs_compiler = pytest.mark.skipif(
    compiled(SOURCE, torch.float32) is None, reason="no C compiler on this machine: no overlapping windows"
)


@needs_compiler
class TestOverlapRender(RenderTester):
    @pytest.fixture(autouse=True)
    def _on_processors(self, device, dtype):
        if torch.device(device).type != "cpu" or dtype not in ATOL:
            pytest.skip("overlapping windows are transformed on processors, in float32 and float64")

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_feature_equals_the_dense_render(self, compositing, layers, border, dtype):
        for batch, channels, size, height, width in ((2, 3, 5, 31, 96), (1, 1, 7, 64, 33), (3, 2, 1, 17, 40)):
            bank = make_bank(5, channels, size, dtype=dtype, light=0.8, veil=True)
            image, defocus = make_scene(bank, batch, height, width)
            options = {"layers": layers, "border": border, "correlate": height == 31}
            self.assert_equals_dense("overlap", image, defocus, bank, compositing, ATOL[dtype], **options)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_equals_the_dense_render_of_hard_scenes(self, compositing, layers, kind, dtype):
        bank = make_bank(6, 2, 15, dtype=dtype, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 43, 70)
        defocus = depth_map(kind, bank, 43, 70).expand(2, -1, -1, -1)
        self.assert_equals_dense("overlap", image, defocus, bank, compositing, ATOL[dtype], layers=layers)

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", ["reflect", "zero"])
    def test_gradcheck_equals_the_dense_gradients(self, compositing, layers, border, dtype):
        """To image, defocus, PSFs and veil; with one depth map for all images."""
        bank = make_bank(5, 2, 7, dtype=dtype, light=0.8, veil=True)
        image, defocus = make_scene(bank, 2, 40, 75)
        atol = {torch.float32: 1e-4, torch.float64: 1e-11}[dtype]
        options = {"layers": layers, "border": border}
        self.assert_gradients_equal_dense("overlap", image, defocus[:1], bank, compositing, atol, **options)

    def test_feature_a_large_psf(self):
        """Of 257 px, beyond the image, where a border of zeros allows it."""
        bank = make_bank(3, 1, 257, dtype=torch.float64)
        image, defocus = make_scene(bank, 1, 60, 90)
        self.assert_equals_dense("overlap", image, defocus, bank, "gather", 1e-12, border="zero")

    def test_feature_the_same_bits_on_one_and_two_threads(self, dtype):
        bank = make_bank(6, 3, 31, dtype=dtype)
        image, defocus = make_scene(bank, 2, 150, 130)
        before, coded = torch.get_num_threads(), []
        try:
            for threads in (1, 2):
                torch.set_num_threads(threads)
                scenes = (layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=c) for c in COMPOSITINGS)
                # Threads may be priced differently: the windows are those of one thread.
                coded.append([BACKENDS["overlap"].render(replace(s, grids={OVERLAPS: self.grid(s)})) for s in scenes])
        finally:
            torch.set_num_threads(before)
        assert all(torch.equal(one, two) for one, two in zip(*coded, strict=True))

    @staticmethod
    def grid(scene):
        return candidates(tuple(scene.labels.layer_index.shape), scene.psfs.shape[-1], OVERLAPS)[0]


@needs_compiler
class TestAnyScene(RenderTester):
    @settings(max_examples=25)
    @given(st.data())
    def test_feature_equals_the_dense_render(self, data):
        side = data.draw(st.sampled_from((1, 3, 9, 33, 47)), label="side of the PSFs")
        height, width = (data.draw(st.integers(side // 2 + 1, 120), label=axis) for axis in ("height", "width"))
        layers, compositing = data.draw(st.integers(1, 6)), data.draw(st.sampled_from(COMPOSITINGS))
        torch.manual_seed(data.draw(st.integers(0, 1000), label="seed"))
        bank = make_bank(layers, 1, side, dtype=torch.float64)
        image, defocus = make_scene(bank, 1, height, width)
        mode = data.draw(st.sampled_from(("nearest", "linear")))
        self.assert_equals_dense("overlap", image, defocus, bank, compositing, 1e-12, layers=mode)


class TestChoice(RenderTester):
    @pytest.mark.parametrize("psf_size", [1, 3, 23, 65, 129, 513, 2001])
    @pytest.mark.parametrize("shape", [(1, 1, 1), (2, 40, 2000), (1, 3000, 4000)])
    def test_cardinality_windows_hold_the_psf_and_have_a_size_that_c_transforms(self, psf_size, shape):
        for grid in candidates(shape, psf_size, OVERLAPS):
            assert grid.size >= psf_size
            assert all(is_window_size(grid.size, dtype) for dtype in (torch.float32, torch.float64))

    @needs_compiler
    def test_feature_it_is_taken_for_psfs_of_an_ordinary_size(self):
        bank = make_bank(6, 3, 41, dtype=torch.float32)
        image, defocus = make_scene(bank, 1, 400, 400)
        for compositing in COMPOSITINGS:
            scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing)
            assert choose(scene).name == "overlap"
            assert window_size(scene) == scene.grids[OVERLAPS].size

    @pytest.mark.parametrize(
        ("where", "compositing", "message"),
        [
            ("meta", "gather", "are transformed on processors, and the image is on 'meta'"),
            ("cpu", "occlusion", "gather and scatter light, and hide none"),
        ],
    )
    def test_exception_scenes_that_are_not_supported(self, where, compositing, message):
        bank = make_bank(3, 1, 5, dtype=torch.float32)
        image, defocus = make_scene(bank, 1, 20, 40)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing=compositing)
        if where == "meta":
            labels = replace(scene.labels, layer_index=scene.labels.layer_index.to("meta"))
            scene = replace(scene, labels=labels)
        assert message in (refusal(BACKENDS["overlap"], scene) or "")

    def test_exception_without_a_compiler(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.render.backends.overlap.compiled", lambda source, dtype: None)
        bank = make_bank(3, 1, 5)
        image, defocus = make_scene(bank, 1, 20, 40)
        scene = layered_scene(image, defocus, bank.defocus, bank.psfs, compositing="scatter")
        assert "need a C compiler" in explain(scene).objections["overlap"]
        assert choose(replace(scene, grids={})).name != "overlap"
        with pytest.raises(ValueError, match=r"method 'overlap' does not support this scene: .* need a C compiler"):
            choose(scene, "overlap")
