"""`raw reconstruct` of a 24-megapixel raw file with a network of the library's own: memory, progress, seams."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.data import dead_leaves, read_image
from kornia_tidy.lab.raw import RawCapture, develop, simulate_scene
from kornia_tidy.lab.raw.dng_file import write_dng
from kornia_tidy.reconstruction import receptive_field
from kornia_tidy.reconstruction.light_head import LightHead
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.whole_picture import whole_picture
from tests.base import BaseTester

ROWS, COLUMNS = 4000, 6000
SIDE = 250  # of the scene that is simulated, and repeated in rows and columns
KEPT = 64  # px across, of a strip that the network sees as a whole
MOST_MEMORY = 2 << 30  # bytes
SEAM = 1e-3  # of full scale, by which tiles may differ from the whole

SCRIPT = """
import sys
from kornia_tidy import cli
status = cli.main(sys.argv[1:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(1024 * int(peak.split()[1]))
sys.exit(status)
"""  # what a parent is told of a child counts what it had itself when it forked


@pytest.fixture
def capture(tmp_path):
    optics = load_pretrained("edof-5").optics
    optics.sensor = None
    image, depth = dead_leaves(SIDE, SIDE, depth_range=optics.camera.depth_range, num_leaves=250, seed=1)
    camera = replace(RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", 256, 4095), camera_to_srgb=torch.eye(3))
    raw = simulate_scene(image, depth, optics, camera, SensorNoise.physical(10500, 2.4))
    path = tmp_path / "large.dng"
    write_dng(path, replace(raw, counts=raw.counts.repeat(1, ROWS // SIDE, COLUMNS // SIDE)))
    return path


def seen_whole(head, light):
    with torch.no_grad():
        return head(light[None].contiguous(memory_format=torch.channels_last))[0][0].clamp(0, 1)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from Linux's /proc")
class TestLargeCapture(BaseTester):
    @pytest.mark.timeout(1200)
    def test_feature_24_megapixels_take_two_gibibytes_and_show_no_seam(self, capture):
        """On two threads. A strip from end to end crosses every cut of the tiles, wherever these are."""
        command = [sys.executable, "-c", SCRIPT, "raw", "reconstruct", str(capture), "--head", "edof-5"]
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "2")
        run = [*command, "-o", str(capture.parent)]
        done = subprocess.run(run, env={**os.environ, **threads}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        most = int(done.stdout.splitlines()[-1])
        print(f"peak memory {most / 2**20:.0f} MiB")
        assert most <= MOST_MEMORY
        shown = [float(part) for part in re.findall(r"(\d\.\d\d)/1 \[", done.stderr)]
        assert len(set(shown)) > 5
        assert shown == sorted(shown)

        head = LightHead(load_pretrained("edof-5"))
        light = develop(RawCapture.open(capture), white_balance="daylight", encoded=False, upright=False)
        written = read_image(capture.with_suffix(".png"))
        assert written.shape == (3, ROWS, COLUMNS)
        margin = -(-receptive_field(head) // 16) * 16
        for axis, begin in ((1, 2000), (2, 3008)):  # multiples of the network's stride, as both sides are
            strip = light.narrow(axis, begin - margin, KEPT + 2 * margin)
            with whole_picture(head, light[None]):
                whole = seen_whole(head, strip).narrow(axis, margin, KEPT)
            assert (written.narrow(axis, begin, KEPT) - whole).abs().max() <= SEAM
