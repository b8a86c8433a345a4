from __future__ import annotations

import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
import scipy.stats
import torch
from torch.autograd import forward_ad
from torch.utils.flop_counter import FlopCounterMode

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.planning.planner import Planner
from kornia_tidy.render.backends.block_plan import plan_blocks
from kornia_tidy.render.backends.tile_plan import BLOCKS, choose_grid
from kornia_tidy.render.cost_model import (
    Tiles,
    bank_operations,
    count_tiles,
    label_pixels,
    rendering_bytes,
    rendering_seconds,
    window_side,
)
from tests.base import BaseTester, needs_data
from tests.capture_memory import predicted_over_used
from tests.scenes import load_scene


def _plan(labels, layers, psf_size):
    return plan_blocks(labels, layers, choose_grid(labels, layers, psf_size), BLOCKS)


class TestCost(BaseTester):
    @pytest.mark.parametrize("fidelity", [Fidelity(window=31), Fidelity(window=15, pixel_tolerance=1e-6, double=True)])
    def test_feature_matrix_products_are_those_that_torch_counts(self, fidelity):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=fidelity)
        # Forward-mode derivatives have the matrix products made in torch, where they are counted.
        with FlopCounterMode(display=False) as counter, forward_ad.dual_level():
            optics.psf_bank(3, None, (-5.0, 0.0, 5.0))
        counted = counter.get_total_flops()
        expected = bank_operations(Planner(optics, 3).survey.geometry(fidelity), fidelity, 3) / (
            2 if fidelity.double else 1
        )
        assert expected == pytest.approx(counted, rel=0.05)

    def test_feature_tiles_are_those_of_the_renderer(self):
        """Against the plan that the renderer makes, where every pixel is looked at: some pairs are few pixels."""
        rows = torch.linspace(-10, 10, 300).view(1, 1, -1, 1).expand(1, 1, 300, 400)
        nodes = tuple(float(psi) for psi in range(-20, 21, 2))
        labels = label_pixels(rows, 2, nodes, "linear")
        counted, plan = count_tiles(labels, len(nodes), 31), _plan(labels, len(nodes), 31)
        assert (counted.size, counted.blocks) == (plan.grid.size, plan.grid.blocks)
        assert 0.7 < counted.pairs / sum(len(chunk.block) for chunk in plan.chunks) <= 1
        assert counted.layers == len(plan.present) == 11
        assert (counted.pixels, counted.terms) == (2 * 300 * 400, 2)

    def test_feature_rendering_grows_with_channels_pairs_and_precision(self):
        fidelity, tiles = Fidelity(window=23), Tiles(64, 40, 120, 9, 10**5, 2)
        one = rendering_seconds(tiles, 1, fidelity)
        assert rendering_seconds(tiles, 3, fidelity) == pytest.approx(3 * one)
        assert rendering_seconds(tiles, 1, fidelity.replace(double=True)) == pytest.approx(2 * one)
        assert one < rendering_seconds(replace(tiles, pairs=240), 1, fidelity) < 2 * one

    def test_feature_the_faster_way_counts(self, monkeypatch):
        """By transforms or directly, on one core; who spreads light cannot go directly."""
        monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
        rows = torch.linspace(-10, 10, 128).view(1, 1, -1, 1).expand(1, 1, 128, 128)
        nodes = tuple(float(psi) for psi in range(-20, 21, 2))
        labels = label_pixels(rows, 2, nodes, "nearest")
        if count_tiles(labels, len(nodes), 9).strips is None:
            pytest.skip("no C compiler on this machine: all is rendered by transforms")
        assert count_tiles(labels, len(nodes), 9, gathers=False).strips is None
        for window, directly in ((9, True), (129, False)):
            tiles, fidelity = count_tiles(labels, len(nodes), window), Fidelity(window=window)
            by_transforms = replace(tiles, strips=None)
            assert (rendering_seconds(tiles, 3, fidelity) < rendering_seconds(by_transforms, 3, fidelity)) == directly
            assert (rendering_bytes(tiles, 3, fidelity) < rendering_bytes(by_transforms, 3, fidelity)) == directly

    @needs_data
    @pytest.mark.slow
    def test_feature_what_is_predicted_cheaper_is_faster(self):
        """Rank correlation of predicted and measured time over candidates from the cheapest to the dearest."""
        optics = TiDyOptics(PixelwiseMask(2), sensor=None, fidelity=Fidelity(window=9), color_space="linear")
        scene = load_scene("aloe")
        image, depth = scene.image[None, :, :512, :512], scene.depth[None, :, :512, :512]
        planned = Planner(optics, 3).scene(optics.camera.defocus(depth), image)
        predicted, measured = [], []
        for layers, spacing, window in product(("nearest", "linear"), (8.0, 2.0), (9, 33, 85, 129)):
            fidelity = Fidelity(layers=layers, layer_spacing=spacing, window=window)
            predicted.append(planned.seconds(fidelity))
            camera, times = optics.with_fidelity(fidelity), []
            for _ in range(3):
                start = time.perf_counter()
                with torch.no_grad():
                    camera(image, depth)
                times.append(time.perf_counter() - start)
            measured.append(min(times))
        assert scipy.stats.spearmanr(predicted, measured).statistic > 0.9

    def test_exception_a_window_must_be_fixed(self):
        with pytest.raises(ValueError, match="needs a fixed window, got window=None of 'balanced'"):
            window_side(Fidelity())

    @pytest.mark.slow
    @pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from Linux's /proc")
    @pytest.mark.parametrize(("side", "window"), [(1024, 23), (768, 65)])
    def test_feature_memory_is_what_the_process_takes(self, side, window):
        # What the library keeps of its memory differs from machine to machine.
        assert 0.7 < predicted_over_used(side, window, "gather") < 1.8
