from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from torch.utils.flop_counter import FlopCounterMode

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.planning import Planner
from kornia_tidy.render_cost import bank_operations, rendering_operations, window_side
from tests.base import BaseTester

MEMORY = """
import sys, warnings, torch
from kornia_tidy import Fidelity, TiDyOptics
from kornia_tidy.planning import Planner
from kornia_tidy.render_cost import memory_bytes
import torch._dynamo  # counted as no part of the capture
warnings.simplefilter("ignore")
def peak():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) * 1024
torch.set_num_threads(1)
side, window = int(sys.argv[1]), int(sys.argv[2])
fidelity = Fidelity(window=window)
optics = TiDyOptics(sensor=None, fidelity=fidelity, color_space="linear")
image, depth = torch.rand(1, 3, side, side), 0.3 + 5 * torch.rand(1, 1, side, side)
with torch.no_grad():
    optics(image[..., :80, :80], depth[..., :80, :80] * 0 + 0.3)
    before = peak()
    optics(image, depth)
    used = peak() - before
print(memory_bytes(Planner(optics, 3).geometry, image.shape, "reflect", fidelity, 21) / used)
"""


class TestCost(BaseTester):
    @pytest.mark.parametrize("fidelity", [Fidelity(window=31), Fidelity(window=15, pixel_tolerance=1e-6, double=True)])
    def test_feature_matrix_products_are_those_that_torch_counts(self, fidelity):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=fidelity)
        with FlopCounterMode(display=False) as counter:
            optics.psf_bank(3, None, (-5.0, 0.0, 5.0))
        counted = counter.get_total_flops()
        expected = bank_operations(Planner(optics, 3).geometry, fidelity, 3) / (2 if fidelity.double else 1)
        assert expected == pytest.approx(counted, rel=0.05)

    def test_feature_rendering_grows_with_batch_layers_and_precision(self):
        fidelity = Fidelity(window=23)
        one = rendering_operations((1, 3, 100, 100), "reflect", fidelity, 4)
        assert rendering_operations((1, 3, 100, 100), "reflect", fidelity.replace(double=True), 4) == 2 * one
        eight = rendering_operations((8, 3, 100, 100), "reflect", fidelity, 4)
        assert 5 < eight / one < 8  # PSFs are transformed once
        assert rendering_operations((1, 3, 100, 100), "valid", fidelity, 4) < one

    def test_exception_a_window_must_be_fixed(self):
        with pytest.raises(ValueError, match="needs a fixed window, got window=None of 'balanced'"):
            window_side(Fidelity())

    @pytest.mark.slow
    @pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from Linux's /proc")
    @pytest.mark.parametrize(("side", "window"), [(1024, 23), (768, 65)])
    def test_feature_memory_is_what_the_process_takes(self, side, window):
        run = [sys.executable, "-c", MEMORY, str(side), str(window)]
        done = subprocess.run(run, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert 0.7 < float(done.stdout) < 1.4
