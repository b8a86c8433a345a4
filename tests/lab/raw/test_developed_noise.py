from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.lab.raw import RawCapture, RawInfo, develop
from kornia_tidy.lab.raw.developed_noise import developed_noise
from kornia_tidy.lab.raw.tags import NOISE_PROFILE, camera_tags
from tests.base import BaseTester
from tests.lab.raw.dng import DOUBLE, dng

COUNTS = np.random.default_rng(0).integers(64, 1000, (36, 48))
BALANCE, MATRIX = (2.0, 1.0, 1.5), torch.tensor([[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]])


class TestNoiseProfile(BaseTester):
    @pytest.mark.parametrize("values", [[2e-4, 1e-6], [2e-4, 1e-6, 1e-4, 2e-6, 3e-4, 0.0]])
    def test_feature_a_pair_for_all_colours_or_each(self, values):
        found = camera_tags(dng(COUNTS, extra={NOISE_PROFILE: (DOUBLE, values)}))["noise_profile"]
        assert [number for pair in found for number in pair] == values

    @pytest.mark.parametrize("values", [[0.0, 0.0], [-1e-4, 1e-6], [float("nan"), 1e-6], [1e-4], [2.0, 1e-6]])
    def test_exception_values_that_are_no_noise(self, values):
        assert "noise_profile" not in camera_tags(dng(COUNTS, extra={NOISE_PROFILE: (DOUBLE, values)}))

    def test_feature_the_decoder_passes_it_on(self):
        data = dng(COUNTS, extra={NOISE_PROFILE: (DOUBLE, [2e-4, 1e-6])})
        assert RawCapture.open(data).info.noise_profile == ((2e-4, 1e-6),)
        assert RawCapture.open(dng(COUNTS)).info.noise_profile is None


class TestDevelopedNoise(BaseTester):
    @pytest.mark.parametrize("profile", [((2e-4, 4e-6),), ((2e-4, 4e-6), (1e-4, 2e-6), (4e-4, 8e-6))])
    def test_feature_it_is_the_noise_of_developed_pictures(self, profile):
        """Of linear RGB, which is not demosaiced. A variance of 40,000 samples is within 5 sqrt(2 / n) of the true."""
        generator = torch.Generator().manual_seed(0)
        pairs = torch.tensor(profile if len(profile) == 3 else profile * 3)
        for level in (0.02, 0.3):
            clean = level / torch.tensor(BALANCE)  # grey when balanced
            deviation = (pairs[:, 0] * clean + pairs[:, 1]).sqrt()
            values = clean[:, None, None] + deviation[:, None, None] * torch.randn(3, 200, 200, generator=generator)
            raw = RawCapture(
                (1000 * 64 + 50_000 * values).round().int(), None, "RGB", torch.full((3,), 64_000.0), 114_000.0,
                camera_to_srgb=MATRIX, white_balance=torch.tensor(BALANCE), info=RawInfo(noise_profile=profile),
            )  # fmt: skip
            found = develop(raw, encoded=False, highlights="keep").var((1, 2)).mean()
            told = developed_noise(raw).std(torch.tensor(level)).square()
            assert found == pytest.approx(float(told), rel=5 * (2 / 40_000) ** 0.5)

    def test_feature_without_profile_there_is_none(self):
        assert developed_noise(RawCapture.from_counts(torch.zeros(1, 4, 4), "RGGB", 0, 1023)) is None

    def test_feature_monochrome_and_shot_noise_free(self):
        grey = RawCapture(torch.zeros(1, 4, 4), None, "", torch.zeros(1), 1023.0)
        sensor = developed_noise(replace(grey, info=RawInfo(noise_profile=((0.0, 4e-6),))))
        assert (sensor.sigma, sensor.full_well) == (pytest.approx(2e-3), None)

    def test_feature_a_measured_sensor_takes_the_place_of_the_profile(self):
        """Its variance in the sensor's units is a profile; a converter's rounding counts too."""
        raw = RawCapture.from_counts(torch.from_numpy(COUNTS)[None], "RGGB", 64, 1023)
        raw = replace(raw, camera_to_srgb=MATRIX, white_balance=torch.tensor([*BALANCE, 1.0]))
        sensor = SensorNoise(1e-3, full_well=5000.0, bits=10)
        profile = (1 / 5000, 1e-6 + 1 / 1023**2 / 12)
        wanted = developed_noise(replace(raw, info=RawInfo(noise_profile=(profile,))))
        found = developed_noise(replace(raw, info=RawInfo(noise_profile=((0.5, 0.5),))), None, sensor)
        assert found.sigma == pytest.approx(wanted.sigma, rel=1e-9)
        assert found.full_well == pytest.approx(wanted.full_well, rel=1e-9)
