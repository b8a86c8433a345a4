from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from kornia_tidy.render.backends.tile_plan import WINDOWS, choose_grid
from kornia_tidy.render.backends.window_plan import plan_windows
from kornia_tidy.render.cost_model import label_pixels
from kornia_tidy.render.occlusion_cost import Windows, count_windows, windows_bytes, windows_seconds
from tests.base import BaseTester
from tests.capture_memory import predicted_over_used

NODES = tuple(float(psi) for psi in range(-20, 21, 2))


def ramp(height: int, width: int) -> torch.Tensor:
    return torch.linspace(-10, 10, height).view(1, 1, -1, 1).expand(1, 1, height, width)


class TestCost(BaseTester):
    @pytest.mark.parametrize("mode", ["nearest", "linear"])
    def test_feature_windows_are_those_of_the_renderer(self, mode):
        """Against the plan that the renderer makes, where every pixel is looked at."""
        labels = label_pixels(ramp(330, 430), 1, NODES, mode)
        counted = count_windows(labels, len(NODES), 31)
        grid = choose_grid(labels, len(NODES), 31, WINDOWS)
        plan = plan_windows(labels, len(NODES), 3, grid, WINDOWS, dark=False)
        held = torch.cat([chunk.layers.new_full((len(chunk.layers),), chunk.layers.shape[1]) for chunk in plan.chunks])
        assert counted.size == plan.grid.size
        assert 0.8 < counted.held.sum() / held.sum() <= 1
        assert counted.layers == len(plan.present) == 11
        assert counted.pixels == 330 * 430

    def test_feature_wide_psfs_do_not_get_windows_beyond_the_cache(self):
        """A flat scene has one layer whatever the tiles; where there are many, small windows are cheaper a sample."""
        many = label_pixels(ramp(264, 264), 1, NODES, "nearest")  # an image of 200 x 200 pixels, padded
        assert choose_grid(many, len(NODES), 65, WINDOWS).size == 144

    def test_feature_time_grows_with_channels_and_with_layers(self):
        few, many = (Windows(64, torch.full((40,), number), 21, 2**16) for number in (2, 4))
        assert windows_seconds(few, 3) == pytest.approx(3 * windows_seconds(few, 1))
        assert 2 < windows_seconds(many, 1) / windows_seconds(few, 1) < 3

    def test_feature_memory_grows_with_the_layers_of_a_window_and_the_precision_of_the_image(self):
        few, many = (Windows(256, torch.full((40,), number), 21, 2**20) for number in (2, 40))
        assert windows_bytes(many, 3, 4) > windows_bytes(few, 3, 4)
        assert windows_bytes(few, 3, 8) - windows_bytes(few, 3, 4) == 2 * 3 * 4 * 2**20

    def test_feature_the_faster_way_counts(self):
        small, large = (count_windows(label_pixels(ramp(200, 200), 1, NODES, "nearest"), 21, side) for side in (9, 91))
        if small.direct is None:
            pytest.skip("no C compiler on this machine: all is rendered by tiles")
        for windows, directly in ((small, True), (replace(small, direct=1e12), False)):
            by_tiles = replace(windows, direct=None)
            assert (windows_seconds(windows, 3) < windows_seconds(by_tiles, 3)) == directly
            assert (windows_bytes(windows, 3, 4) < windows_bytes(by_tiles, 3, 4)) == directly
        assert large.direct > 2 * small.direct

    @pytest.mark.slow
    @pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from Linux's /proc")
    @pytest.mark.parametrize(("side", "window"), [(1024, 23), (768, 65)])
    def test_feature_memory_is_what_the_process_takes(self, side, window):
        assert 0.7 < predicted_over_used(side, window, "occlusion") < 1.8
