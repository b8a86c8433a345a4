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
from kornia_tidy.planning.bank_cost import bank_operations, bank_work, window_side
from kornia_tidy.planning.planner import Planner
from kornia_tidy.planning.rendering_cost import count_work, label_pixels, rendering_bytes, rendering_seconds
from kornia_tidy.render.backends.block_plan import plan_blocks
from kornia_tidy.render.backends.tile_plan import BLOCKS, WINDOWS, choose_grid
from kornia_tidy.render.backends.window_plan import plan_windows
from kornia_tidy.render.cost_model import TiledWork
from kornia_tidy.render.dispatch import BACKENDS, refusal
from kornia_tidy.render.scene import layered_scene
from tests.base import BaseTester, needs_data
from tests.capture_memory import predicted_over_used
from tests.scenes import load_scene

NODES = tuple(float(psi) for psi in range(-20, 21, 2))
COMPOSITING = ("gather", "scatter", "occlusion")


def ramp(height: int, width: int) -> torch.Tensor:
    return torch.linspace(-10, 10, height).view(1, 1, -1, 1).expand(1, 1, height, width)


class TestBank(BaseTester):
    @pytest.mark.parametrize("fidelity", [Fidelity(window=31), Fidelity(window=15, pixel_tolerance=1e-6, double=True)])
    def test_feature_matrix_products_are_those_that_torch_counts(self, fidelity):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=fidelity)
        # Forward-mode derivatives have the matrix products made in torch, where they are counted.
        with FlopCounterMode(display=False) as counter, forward_ad.dual_level():
            optics.psf_bank(3, None, (-5.0, 0.0, 5.0))
        counted = counter.get_total_flops()
        expected = bank_operations(Planner(optics, 3).samples.geometry(fidelity), fidelity, 3) / (
            2 if fidelity.double else 1
        )
        assert expected == pytest.approx(counted, rel=0.05)

    @pytest.mark.parametrize("double", [False, True])
    def test_feature_all_operations_are_priced_once(self, double):
        fidelity = Fidelity(window=31, double=double)
        geometry = Planner(TiDyOptics(PixelwiseMask(2), fidelity=fidelity), 3).samples.geometry(fidelity)
        terms = bank_work(geometry, fidelity, 5).terms
        assert sum(terms[1:]) == bank_operations(geometry, fidelity, 5)
        assert (sum(terms[1::2]) > 0) != double  # products and intensities in float32

    def test_exception_a_window_must_be_fixed(self):
        with pytest.raises(ValueError, match="needs a fixed window, got window=None of 'balanced'"):
            window_side(Fidelity())


class TestCount(BaseTester):
    @pytest.mark.parametrize("compositing", COMPOSITING)
    @pytest.mark.parametrize("mode", ["nearest", "linear"])
    def test_feature_the_work_is_what_the_backends_say_of_the_scene(self, compositing, mode):
        """The planner counts from labels alone what the dispatcher counts from the scene."""
        psi, window = ramp(90, 120), 13
        image, psfs = torch.rand(1, 1, 90, 120), torch.rand(len(NODES), 1, window, window)
        options = {"compositing": compositing, "layers": mode, "border": "replicate"}
        scene = layered_scene(image, psi, torch.tensor(NODES), psfs, **options)
        counted = count_work(scene.labels, len(NODES), window, compositing)
        able = {name: backend for name, backend in BACKENDS.items() if refusal(backend, scene) is None}
        assert counted.works == {name: backend.work(scene) for name, backend in able.items()}
        assert counted.layers == 11
        assert counted.image_pixels == 90 * 120

    def test_feature_tiles_are_those_of_the_renderer(self):
        """Against the plan that the renderer makes, where every pixel is looked at: some pairs are few pixels."""
        labels = label_pixels(ramp(300, 400), 2, NODES, "linear")
        counted = count_work(labels, len(NODES), 31)
        plan = plan_blocks(labels, len(NODES), choose_grid(labels, len(NODES), 31), BLOCKS, offset=30)
        tiles = counted.works["tiled"]
        assert isinstance(tiles, TiledWork)
        assert (tiles.size, tiles.blocks) == (plan.grid.size, plan.grid.blocks)
        assert 0.7 < tiles.pairs / sum(len(chunk.block) for chunk in plan.chunks) <= 1
        assert counted.layers == tiles.layers == len(plan.present) == 11
        assert (tiles.pixels, tiles.blended) == (2 * 300 * 400, 2)

    @pytest.mark.parametrize("mode", ["nearest", "linear"])
    def test_feature_windows_are_those_of_the_renderer(self, mode):
        labels = label_pixels(ramp(330, 430), 1, NODES, mode)
        counted = count_work(labels, len(NODES), 31, "occlusion")
        grid = choose_grid(labels, len(NODES), 31, WINDOWS)
        plan = plan_windows(labels, len(NODES), 3, grid, WINDOWS, dark=False)
        held = sum(chunk.layers.numel() for chunk in plan.chunks) - sum(len(chunk.fillers) for chunk in plan.chunks)
        windows = counted.works["tiled"]
        assert windows.size == plan.grid.size
        assert sum(windows.windows) == grid.blocks
        assert 0.8 < sum(layers * count for layers, count in enumerate(windows.windows)) / held <= 1
        assert windows.pixels == 300 * 400


class TestCost(BaseTester):
    def test_feature_time_grows_with_channels_and_precision(self):
        for compositing in COMPOSITING:
            scene = count_work(label_pixels(ramp(256, 256), 1, NODES, "linear"), len(NODES), 41, compositing)
            one, three = (rendering_seconds(scene, channels, threads=1) for channels in (1, 3))
            assert one < three <= 3 * one * (1 + 1e-12)
            assert one <= rendering_seconds(scene, 1, double=True, threads=1) <= 2.01 * one

    def test_feature_more_threads_take_less_time(self):
        scene = count_work(label_pixels(ramp(256, 256), 1, NODES, "linear"), len(NODES), 41)
        one, four = (rendering_seconds(scene, 3, threads=threads) for threads in (1, 4))
        assert one / 4 < four < one

    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    def test_feature_the_fastest_way_counts_in_time_and_in_memory(self, compositing):
        labels = label_pixels(ramp(200, 200), 1, NODES, "nearest")
        small = count_work(labels, len(NODES), 9, compositing)
        if "direct" not in small.works:
            pytest.skip("no C compiler on this machine: nothing is rendered directly")
        slow = replace(small.works["direct"], **{"strips" if compositing == "gather" else "pairs": 10**9})
        for scene, directly in ((small, True), (replace(small, works={**small.works, "direct": slow}), False)):
            others = replace(scene, works={name: work for name, work in scene.works.items() if name != "direct"})
            assert (rendering_seconds(scene, 3) < rendering_seconds(others, 3)) == directly
            assert (rendering_bytes(scene, 3) < rendering_bytes(others, 3)) == directly

    def test_feature_dense_counts_only_where_the_dispatcher_may_take_it(self):
        """Its memory is not bounded: large images go elsewhere, whatever it would save over tiles."""
        psi, nodes = torch.zeros(1, 1, 256, 256), (-1.0, 0.0, 1.0)
        one, many = (count_work(label_pixels(psi, batch, nodes, "nearest"), 3, 129) for batch in (1, 200))

        def seconds(scene, *names):
            return rendering_seconds(replace(scene, works={name: scene.works[name] for name in names}), 3)

        assert seconds(one, "dense") == seconds(one, "tiled", "dense") < seconds(one, "tiled")
        assert seconds(many, "tiled", "dense") == seconds(many, "tiled")
        dense = {"dense": many.works["dense"]}
        with pytest.raises(ValueError, match="empty"):
            rendering_seconds(replace(many, works=dense), 3)

    def test_feature_memory_grows_with_the_precision_of_the_image(self):
        for compositing in COMPOSITING:
            scene = count_work(label_pixels(ramp(300, 300), 1, NODES, "linear"), len(NODES), 65, compositing)
            assert rendering_bytes(scene, 3) < rendering_bytes(scene, 3, double=True)

    @needs_data
    @pytest.mark.slow
    def test_feature_what_is_predicted_cheaper_is_faster(self):
        """Rank correlation of predicted and measured time over candidates from the cheapest to the dearest."""
        optics = TiDyOptics(PixelwiseMask(2), sensor=None, fidelity=Fidelity(window=9), color_space="linear")
        scene = load_scene("aloe")
        image, depth = scene.image[None, :, :512, :512], scene.depth[None, :, :512, :512]
        planned = Planner(optics, 3).scene(optics.camera.defocus(depth), image)
        fidelities = [
            Fidelity(layers=layers, layer_spacing=spacing, window=window)
            for layers, spacing, window in product(("nearest", "linear"), (8.0, 2.0), (9, 33, 85, 129))
        ]
        cameras = [optics.with_fidelity(fidelity) for fidelity in fidelities]
        times = [[] for _ in fidelities]
        for _ in range(4):  # of all in turn: a machine that is busy for a while slows all down
            for camera, taken in zip(cameras, times, strict=True):
                start = time.process_time()
                with torch.no_grad():
                    camera(image, depth)
                taken.append(time.process_time() - start)
        predicted, measured = [planned.seconds(each) for each in fidelities], [min(taken) for taken in times]
        assert scipy.stats.spearmanr(predicted, measured).statistic > 0.9

    @pytest.mark.slow
    @pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from Linux's /proc")
    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    @pytest.mark.parametrize(("side", "window"), [(1024, 23), (768, 65)])
    def test_feature_memory_is_what_the_process_takes(self, side, window, compositing):
        # Libraries need memory of their own, which differs from machine to machine.
        assert 0.7 < predicted_over_used(side, window, compositing) < 1.8
