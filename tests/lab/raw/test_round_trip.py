"""From a scene to a camera's raw file and back: the network that comes with the library, on what its camera wrote."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch
from kornia.color import linear_rgb_to_rgb

from kornia_tidy import SensorNoise
from kornia_tidy.data import dead_leaves
from kornia_tidy.lab.raw import RawCapture, develop, simulate_scene
from kornia_tidy.lab.raw.dng_writer import encode_dng
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import load_pretrained
from tests.base import BaseTester

SIDE = 128
LEAST_GAIN = 1.0  # dB over the capture
MATRIX = torch.tensor([[0.9, -0.3, -0.1], [-0.8, 1.6, 0.3], [-0.3, 0.3, 0.8]])  # XYZ to a camera's colours


def small():
    """12 bits, red, green and blue as sRGB's; the noise of a small sensor."""
    blank = RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", 256, 4095)
    return replace(blank, camera_to_srgb=torch.eye(3)), SensorNoise.physical(10500, 2.4)


def large():
    """A camera with 14 bits, another corner of the tile, and half the response of green in red and blue."""
    blank = RawCapture.from_counts(torch.zeros(1, 2, 2), "GBRG", [1000, 1024, 1030, 1024], 16383)
    own = {"xyz_to_camera": MATRIX, "white_balance": torch.tensor([2.2, 1.0, 1.6, 1.0])}
    return replace(blank, **own), SensorNoise.physical(30000, 3)


@functools.cache
def system():
    trained = load_pretrained("edof-5")
    trained.optics.sensor = None  # the raw file's noise is the camera's
    return trained.optics, LightHead(trained)


def scores(image, depth, camera, noise):
    """PSNR of the developed capture and of the reconstruction, and the raw capture; through a DNG file."""
    optics, head = system()
    raw = simulate_scene(image, depth, optics, camera, noise, generator=torch.Generator().manual_seed(0))
    read = RawCapture.open(encode_dng(raw))
    assert torch.equal(read.counts, raw.counts)
    light = develop(read, white_balance="daylight", encoded=False, upright=False)
    estimate = reconstruct_light(head, light).image
    capture = linear_rgb_to_rgb(light.clamp(0, 1))
    return *(float(psnr(picture[None], image[None])) for picture in (capture, estimate)), raw


@pytest.mark.parametrize("sensor", [small, large])
class TestRawRoundTrip(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("seed", [5, 6])
    def test_feature_dead_leaves_are_sharper_than_their_capture(self, sensor, seed):
        far = system()[0].camera.depth_range
        image, depth = dead_leaves(SIDE, SIDE, depth_range=far, num_leaves=SIDE**2 // 256, seed=seed)
        capture, estimate, raw = scores(image, depth, *sensor())
        assert estimate >= capture + LEAST_GAIN
        assert float((raw.counts >= raw.white).float().mean()) < 0.05
