"""Simulated captures against loops, matrices and noise laws written out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.dng_writer import encode_dng
from kornia_tidy.lab.raw.simulation import sensor_counts, simulate_raw, simulate_scene
from tests.base import BaseTester

XTRANS = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"
MATRIX = torch.tensor([[0.9, -0.3, -0.1], [-0.8, 1.6, 0.3], [-0.3, 0.3, 0.8]])  # XYZ to a camera's colours


def camera(pattern="RGGB", bits=12, channels=1, **changes):
    blank = RawCapture.from_counts(torch.zeros(channels, 6, 6), pattern, 2**bits // 16, 2**bits - 1)
    return replace(blank, **changes)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


class TestSensorCounts(BaseTester):
    @pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GBRG", "GRBG", XTRANS])
    @pytest.mark.parametrize("bits", [10, 12, 14, 16])
    def test_feature_each_pixel_sees_its_own_color(self, device, pattern, bits):
        """Against a loop over the pixels, for an image with sides that are not multiples of the tile."""
        light = torch.rand(1, 3, 13, 17, device=device)
        counts = sensor_counts(light, camera(pattern, bits), color="channels")[0, 0].cpu()
        side, black, white = math.isqrt(len(pattern)), 2**bits // 16, 2**bits - 1
        for y in range(13):
            for x in range(17):
                color = "RGB".index(pattern[(y % side) * side + x % side])
                expected = black + (white - black) * float(light[0, color, y, x])
                assert abs(float(counts[y, x]) - expected) <= 0.5 + 1e-2

    @pytest.mark.parametrize(("pattern", "channels"), [(None, 1), (None, 3)])
    def test_cardinality_without_a_filter_array(self, device, pattern, channels):
        light = torch.rand(2, channels, 5, 7, device=device)
        counts = sensor_counts(light, camera(pattern, channels=channels), color="channels")
        self.assert_close(counts, (256 + 3839 * light).round(), rtol=0, atol=1)

    def test_feature_black_levels_stand_at_their_places(self, device):
        levels = torch.tensor([[250.0, 256.0], [260.0, 240.0]])
        counts = sensor_counts(torch.zeros(1, 3, 4, 4, device=device), camera(black=levels), color="channels")
        assert torch.equal(counts[0, 0].cpu(), levels.repeat(2, 2))

    def test_feature_light_that_saturates_reads_white_to_the_count(self, device):
        light = torch.full((1, 3, 64, 64), 1.5, device=device)
        counts = sensor_counts(light, camera(), SensorNoise.physical(9000, 8), color="channels")
        assert counts.unique().tolist() == [4095]

    def test_feature_noise_around_black_is_kept(self, device):
        """Half of it lies below black, with the read noise's deviation and rounding's."""
        light = torch.zeros(1, 3, 256, 256, device=device)
        sensor = SensorNoise.physical(4 * 3839, 20.0)  # 4 electrons a count: 5 counts
        counts = sensor_counts(light, camera(), sensor, color="channels", generator=seeded(0)).double() - 256
        assert abs(float(counts.mean())) < 5 / 256 * 4
        assert float(counts.std()) == pytest.approx(math.sqrt(25 + 1 / 12), rel=0.01)

    @pytest.mark.parametrize("changes", [{"xyz_to_camera": MATRIX}, {"camera_to_srgb": torch.linalg.inv(MATRIX + 1)}])
    def test_feature_balance_and_matrix_take_the_light_back(self, device, changes):
        """Development written out: times the white balance, times the matrix; for colours near grey."""
        balance = torch.tensor([2.1, 1.0, 1.5, 1.0])
        own = camera("RGGB", 16, white_balance=balance, **changes)
        light = 0.5 + 0.2 * torch.rand(1, 3, 1, 1, device=device).expand(1, 3, 4, 4)
        counts = sensor_counts(light, own)[0, 0].cpu().double()
        seen = (counts[:2, :2].flatten() - 4096) / (65535 - 4096) * balance[[0, 1, 3, 2]]  # by places
        if "xyz_to_camera" in changes:
            from_srgb = np.array([[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])
            forward = MATRIX.double().numpy() @ from_srgb
        else:
            forward = np.linalg.inv(changes["camera_to_srgb"].double().numpy())
        to_srgb = torch.from_numpy(np.linalg.inv(forward / forward.sum(1, keepdims=True)))
        self.assert_close(to_srgb @ seen[[0, 1, 3]], light[0, :, 0, 0].cpu(), rtol=0, atol=1e-3)

    def test_feature_white_saturates_the_most_sensitive_channel_alone(self, device):
        own = camera("RGGB", 16, white_balance=torch.tensor([2.0, 1.0, 1.6, 1.0]), xyz_to_camera=MATRIX)
        counts = sensor_counts(torch.ones(1, 3, 2, 2, device=device), own)[0, 0].cpu() - 4096
        self.assert_close(counts / 61439, torch.tensor([[0.5, 1.0], [1.0, 0.625]]), rtol=0, atol=2e-5)

    def test_gradcheck_is_that_of_a_scale_and_zero_where_cut(self, device):
        light = torch.tensor([0.2, 0.4, 1.3], device=device).view(1, 3, 1, 1).expand(1, 3, 2, 2).clone()
        light.requires_grad_()
        sensor_counts(light, camera(), color="channels").sum().backward()
        expected = torch.zeros(3, 2, 2)
        expected[0, 0, 0] = expected[1, 0, 1] = expected[1, 1, 0] = 4095 - 256
        self.assert_close(light.grad[0].cpu(), expected)

    def test_exception_names_what_is_wrong(self, device):
        light = torch.zeros(1, 3, 4, 4, device=device)
        with pytest.raises(ValueError, match=r"light must have shape \(B, 3, H, W\) .* got \(1, 1, 4, 4\)"):
            sensor_counts(light[:, :1], camera())
        with pytest.raises(ValueError, match=r"light must have shape \(B, 1, H, W\)"):
            sensor_counts(light, camera(None))
        with pytest.raises(ValueError, match="camera must have counts, got a capture of floating-point samples"):
            sensor_counts(light, replace(camera(), counts=torch.zeros(1, 4, 4)))
        with pytest.raises(ValueError, match="color must be one of 'camera', 'channels', got 'raw'"):
            sensor_counts(light, camera(), color="raw")
        with pytest.raises(ValueError, match="has no colour matrix: choose color='channels'"):
            sensor_counts(light, camera())
        with pytest.raises(ValueError, match="color='channels' needs a camera of red, green and blue, this has 'GMCY'"):
            sensor_counts(light, camera("GMYC"), color="channels")
        with pytest.raises(ValueError, match="light must be finite, got nan"):
            sensor_counts(light * math.nan, camera(), color="channels")


class TestSimulateRaw(BaseTester):
    def test_feature_the_capture_is_the_cameras_but_for_its_counts(self):
        own = camera("GBRG", 14, flip=6, xyz_to_camera=MATRIX, pixel_aspect=1.5)
        raw = simulate_raw(torch.rand(3, 10, 12), own, SensorNoise.physical(9000, 3), generator=seeded(0))
        assert raw.counts.shape == (1, 10, 12)
        assert raw.counts.dtype == torch.int32
        assert (raw.flip, raw.white, raw.pattern, raw.pixel_aspect) == (0, own.white, own.pattern, 1.5)
        again = simulate_raw(raw.counts.new_zeros(3, 10, 12).float(), raw, None)
        assert torch.equal(again.counts, torch.full((1, 10, 12), 1024, dtype=torch.int32))


class TestSimulateScene(BaseTester):
    def test_feature_scene_to_file_and_back(self):
        """Scene -> optics -> camera -> DNG -> RawCapture.open: the same counts, and planes of the light that came."""
        image, depth = dead_leaves(72, 80, depth_range=(0.3, math.inf), num_leaves=100, seed=0)
        optics = TiDyOptics(PixelwiseMask(2, generator=seeded(0)), sensor=None, fidelity="draft")
        own = camera("GRBG", 14)
        raw = simulate_scene(
            image, depth, optics, own, SensorNoise.physical(60000, 2), color="channels", generator=seeded(1)
        )
        back = RawCapture.open(encode_dng(raw))
        assert torch.equal(back.counts, raw.counts)
        linear = TiDyOptics(optics.masks, sensor=None, fidelity="draft", color_space="linear")
        with torch.no_grad():
            light = linear(optics.decode(image[None]), depth[None])[0]
        places = [light[1, ::2, ::2], light[0, ::2, 1::2], light[2, 1::2, ::2], light[1, 1::2, 1::2]]
        off = back.planes() - torch.stack(places)
        assert float(off.square().mean().sqrt()) < 0.004  # shot noise: sqrt(0.5 / 60000) = 0.003
        assert abs(float(off.mean())) < 2e-4

    def test_exception_optics_with_a_sensor_of_their_own(self):
        with pytest.raises(ValueError, match="optics must have sensor=None, as the noise is the camera's"):
            simulate_scene(torch.rand(3, 64, 64), torch.ones(1, 64, 64), TiDyOptics(), camera())
