"""Measured and predicted peak memory of a capture, in a separate process."""

from __future__ import annotations

import os
import subprocess
import sys

SCRIPT = """
import sys, warnings, torch
from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.accuracy.planner import Planner
import torch._dynamo  # counted as no part of the capture
warnings.simplefilter("ignore")
def peak():
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")) * 1024
torch.set_num_threads(1)
side, fidelity, compositing = int(sys.argv[1]), Fidelity(window=int(sys.argv[2])), sys.argv[3]
masks = PixelwiseMask(1 if compositing == "occlusion" else 5)
options = {"compositing": compositing, "color_space": "linear", "fidelity": fidelity}
optics = TiDyOptics(masks, sensor=None, **options)
y = torch.linspace(0, 6, side)
image, depth = torch.rand(1, 3, side, side), 0.3 + 1.2 * (1 + y.sin()[:, None] * y.cos())[None, None]
if compositing != "occlusion":  # which such a depth would take minutes
    depth = 0.3 + 5 * torch.rand(1, 1, side, side)
with torch.no_grad():
    optics(image[..., :80, :80], depth[..., :80, :80] * 0 + 0.3)
    before = peak()
    optics(image, depth)
    used = peak() - before
scene = Planner(optics, 3).scene(optics.camera.defocus(depth), image)
print(scene._described(fidelity, 1.0).memory_bytes / used)
"""


def predicted_over_used(side: int, window: int, compositing: str) -> float:
    run = [sys.executable, "-c", SCRIPT, str(side), str(window), compositing]
    given_back = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}  # else glibc keeps some of it
    done = subprocess.run(run, env={**os.environ, **given_back}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)
