"""Captures rendered once: stored without noise, cropped, brightened and made noisy for each step, never flipped."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kornia.color import rgb_to_linear_rgb
from torch.utils.data import Dataset

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from kornia_tidy.training.noise_free import LEVELS, NoiseFreeCaptures
from kornia_tidy.training.noisy_crops import (
    FULL_WELL,
    GAIN,
    NoisyCrops,
    full_wells,
    random_gain,
    random_sensor,
    random_window,
)
from kornia_tidy.training.scenes import SceneLoader
from kornia_tidy.training.settings import LightSettings
from tests.base import BaseTester

SIDE = 32


def camera(sigma=0.01, tilt=0.0, **options):
    """A camera of one mask, whose height rises by ``tilt`` metres a pixel and so moves the PSFs along the columns."""
    ramp = tilt * torch.arange(23.0).expand(1, 23, 23)
    return TiDyOptics(PixelwiseMask(initial=ramp), sensor=SensorNoise(sigma), fidelity="draft", **options)


class Points(Dataset):
    """Scenes in focus that are dark but for one pixel."""

    def __len__(self):
        return 3

    def __getitem__(self, index):
        image = torch.zeros(3, SIDE, SIDE)
        image[:, 16, 16] = 1
        return {"image": image, "depth": torch.full((1, SIDE, SIDE), 0.595)}


class Grey(Dataset):
    """Scenes of one light, and a hole in the depth."""

    def __init__(self, light=0.25, side=64):
        self.light, self.side = light, side

    def __len__(self):
        return 40

    def __getitem__(self, index):
        light = torch.full((3, self.side, self.side), self.light)
        depth = torch.full((1, self.side, self.side), 0.5)
        mask = torch.ones_like(depth, dtype=torch.bool)
        mask[..., :4, :] = False
        return {"image": light, "depth": depth, "mask": mask}


@pytest.fixture(scope="module")
def leaves(tmp_path_factory):
    """Captures of dead leaves, and their camera."""
    optics = camera()
    return NoiseFreeCaptures(DeadLeaves(4, SIDE, SIDE), optics, tmp_path_factory.mktemp("captures")), optics


@pytest.fixture(scope="module")
def grey(tmp_path_factory):
    optics = camera(color_space="linear")
    return NoiseFreeCaptures(Grey(), optics, tmp_path_factory.mktemp("captures")), optics


class TestNoiseFreeCaptures(BaseTester):
    def test_feature_they_are_the_cameras_captures_without_noise(self, leaves):
        captures, optics = leaves
        scene = DeadLeaves(4, SIDE, SIDE)[2]
        expected = TiDyOptics(
            optics.masks, sensor=None, fidelity=optics.fidelity
        )(scene["image"][None], scene["depth"][None])  # fmt: skip
        step = 0.5 / LEVELS + 1e-6  # rounding to 16 bits, and that of the encoding
        capture = captures[2]
        self.assert_close(capture.light, rgb_to_linear_rgb(expected)[0].detach().clamp(0, 1), rtol=0, atol=step)
        self.assert_close(capture.image, rgb_to_linear_rgb(scene["image"][None])[0], rtol=0, atol=step)
        depth = normalised_inverse_depth(optics.camera, scene["depth"])
        self.assert_close(capture.inverse_depth, depth, rtol=0, atol=step)
        assert capture.mask.all()

    def test_exception_captures_of_another_camera_or_of_other_scenes(self, tmp_path):
        NoiseFreeCaptures(Points(), camera(), tmp_path, {"seed": 0})
        NoiseFreeCaptures(Points(), camera(sigma=0.3), tmp_path, {"seed": 0})  # the sensor does not matter
        with pytest.raises(ValueError, match=r"holds captures made otherwise \(there / now\): camera"):
            NoiseFreeCaptures(Points(), camera(tilt=1e-7), tmp_path, {"seed": 0})
        with pytest.raises(ValueError, match=r"holds captures made otherwise \(there / now\): set of scenes"):
            NoiseFreeCaptures(Points(), camera(), tmp_path, {"seed": 1})
        assert json.loads((tmp_path / "captures.json").read_text())["set of scenes"] == {"seed": 0}

    def test_exception_a_damaged_file_is_named(self, tmp_path):
        captures = NoiseFreeCaptures(Points(), camera(), tmp_path)
        captures[0]
        path = tmp_path / "000000.npy"
        path.write_bytes(path.read_bytes()[:-5])
        with pytest.raises(ValueError, match=r"000000.npy is damaged, delete it to have it rendered again: its NPY"):
            captures[0]


class TestNoisyCrops(BaseTester):
    def test_convention_no_capture_is_flipped(self, tmp_path):
        """The light of a point lies to its right in every sample, as in a capture by a camera that is tilted so."""
        optics = camera(tilt=1.5e-7, color_space="linear")
        captures = NoiseFreeCaptures(Points(), optics, tmp_path)
        lens = optics.camera
        light = LightSettings(noise_range=(1e-5, 1e-5), electrons=(60e3, 60e3), reference_f_number=lens.f_number)
        crops = NoisyCrops(captures, optics, SIDE - 4, light)
        torch.manual_seed(0)
        columns = torch.arange(SIDE - 4.0)
        for draw in range(24):
            sample = crops[draw % 3]
            column = int(sample["image"][0].amax(0).argmax())
            light = sample["coded"].mean((0, 1))
            light = torch.where(light > 5e-4, light, 0)  # of 1 / 28 rows: 100 times the noise of a column
            assert (light * columns).sum() / light.sum() > column + 1

    def test_feature_the_gain_is_linear_in_capture_and_truth(self, leaves):
        """Divided by the noise-free crop, both are one number for each channel."""
        captures, optics = leaves
        linear = TiDyOptics(optics.masks, sensor=None, fidelity="draft", color_space="linear")
        crops = NoisyCrops(captures, linear, SIDE, LightSettings(noise_range=(1e-6, 1e-6)))
        gains = []
        for seed in range(12):
            torch.manual_seed(seed)
            sample = crops[seed % 4]
            truth = captures[seed % 4]
            gain = sample["image"].sum((1, 2)) / truth.image.sum((1, 2))
            self.assert_close(sample["image"], gain[:, None, None] * truth.image, rtol=1e-4, atol=1e-6)
            if sample["noise"].max() < 2e-6:  # no shot noise
                self.assert_close(sample["coded"], gain[:, None, None] * truth.light, rtol=0, atol=1e-5)
            assert sample["image"].max() <= 1 + 1e-6
            gains.append(gain)
        assert torch.stack(gains).std(0).min() > 0.05
        assert (gains[0] - gains[0].mean()).abs().max() > 1e-3  # channels differ

    @pytest.mark.parametrize("read_only", [True, False])
    def test_feature_the_noise_has_the_standard_deviation_that_is_told(self, read_only, grey, monkeypatch):
        """Of 12,288 samples of one light: within five standard errors, 1 / sqrt(2 n) of it."""
        monkeypatch.setattr("kornia_tidy.training.noisy_crops.SHOT_SHARE", 0.0 if read_only else 1.0)
        captures, optics = grey
        crops, told = NoisyCrops(captures, optics, gain=False), []
        for seed in range(20):
            torch.manual_seed(seed)
            sample = crops[seed]
            noise = float(sample["noise"].square().mean().sqrt())
            assert sample["noise"].shape == sample["coded"].shape
            assert float((sample["coded"] - 0.25).std()) == pytest.approx(noise, rel=5 / math.sqrt(2 * 12288))
            told.append(noise)
        assert 1e-3 <= min(told) < 3.3e-3
        assert 9e-3 < max(told) <= 0.03

    def test_feature_the_noise_is_told_wrongly_in_training(self, grey, monkeypatch):
        """By a factor of 2.5 at most, in both directions; 40 samples of read noise alone, so that it is one number."""
        monkeypatch.setattr("kornia_tidy.training.noisy_crops.SHOT_SHARE", 0.0)
        captures, optics = grey
        light, factors = LightSettings(noise_range=(0.01, 0.01)), []
        crops = NoisyCrops(captures, optics, light=light)
        for seed in range(40):
            torch.manual_seed(seed)
            factors.append(float(crops[seed]["noise"].mean()) / 0.01)
        assert 0.4 - 1e-6 <= min(factors) < 0.8  # less likely than 1e-8 otherwise
        assert 1.25 < max(factors) <= 2.5 + 1e-6
        assert min(abs(factor - 1) for factor in factors) < 0.25
        exact = NoisyCrops(captures, optics, light=replace(light, noise_error=1.0))
        for seed in range(5):
            torch.manual_seed(seed)
            assert float(exact[seed]["noise"].mean()) == pytest.approx(0.01, rel=1e-5)

    def test_feature_shot_noise_is_told_by_the_light_of_each_pixel(self, leaves, monkeypatch):
        """It is the root of read noise and of the noisy capture's own light, both in parts of the full well."""
        monkeypatch.setattr("kornia_tidy.training.noisy_crops.SHOT_SHARE", 1.0)
        captures, _ = leaves
        linear = TiDyOptics(sensor=None, fidelity="draft", color_space="linear")
        light = LightSettings(electrons=(200.0, 200.0), reference_f_number=linear.camera.f_number)
        sample = NoisyCrops(captures, linear, light=light, gain=False)[0]
        expected = ((2.4 / 200) ** 2 + sample["coded"] / 200).sqrt()
        self.assert_close(sample["noise"], expected, rtol=1e-5, atol=1e-7)
        assert sample["noise"].std() > 1e-3

    def test_feature_electrons_fall_with_the_square_of_the_f_number(self):
        light, stopped_down = (
            LightSettings(electrons=(500.0, 1e3), reference_f_number=17.6),
            ThinLensCamera(f_number=35.2),
        )
        assert full_wells(light, stopped_down) == (125.0, 250.0)
        assert full_wells(LightSettings(), stopped_down) == FULL_WELL
        torch.manual_seed(0)
        wells = [random_sensor(light, stopped_down).full_well for _ in range(50)]
        assert all(125 <= well <= 250 for well in wells if well is not None)

    def test_feature_read_noise_is_uniform_in_its_logarithm(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.training.noisy_crops.SHOT_SHARE", 0.0)
        torch.manual_seed(0)
        place = [math.log(random_sensor(LightSettings(), ThinLensCamera()).sigma / 1e-3, 30) for _ in range(2000)]
        # Kolmogorov-Smirnov: a uniform sample of 2000 deviates by more than 0.044 once in a thousand.
        assert np.abs(np.sort(place) - np.linspace(0, 1, 2000)).max() < 0.044

    def test_feature_gains_stay_in_their_range_and_below_full_scale(self):
        torch.manual_seed(0)
        dark = torch.stack([random_gain(torch.full((3,), 0.1)) for _ in range(500)])
        assert dark.shape == (500, 3, 1, 1)
        exposure = dark.log().mean(1)
        assert math.log(GAIN[0]) - 0.25 < exposure.min() < exposure.max() < math.log(GAIN[1]) + 0.25
        bright = torch.stack([random_gain(torch.tensor([1.0, 0.9, 0.0])) for _ in range(100)])
        assert (bright[:, 0] <= 1).all()
        assert (bright[:, 1] <= 1 / 0.9).all()

    def test_feature_crops_cut_all_maps_alike_and_reach_every_place(self):
        torch.manual_seed(0)
        windows = {tuple((part.start, part.stop) for part in random_window(8, 9, 7)[1:]) for _ in range(100)}
        assert windows == {((top, top + 7), (left, left + 7)) for top in range(2) for left in range(3)}

    def test_feature_batches_repeat_by_seed_and_epoch_and_go_on_where_a_state_says(self, leaves):
        captures, optics = leaves
        whole = list(SceneLoader(NoisyCrops(captures, optics, 16), 2, seed=5, augment=True))
        other = SceneLoader(NoisyCrops(captures, optics, 16), 2, seed=5)
        other.load_state_dict({"epoch": 0, "batches": 1})
        (rest,) = list(other)
        assert set(rest) == {"coded", "image", "inverse_depth", "mask", "noise", "index", "name", "noise_seed"}
        assert rest["noise"].shape == (2, 3, 16, 16)
        for name in ("coded", "image", "inverse_depth", "mask", "noise"):
            assert torch.equal(rest[name], whole[1][name])
        other._batches.set_epoch(1)
        assert not any(torch.equal(batch["noise"], old["noise"]) for batch, old in zip(other, whole, strict=True))

    def test_feature_unknown_depth_stays_unknown(self, grey):
        captures, optics = grey
        assert NoisyCrops(captures, optics)[0]["mask"].sum() == 60 * 64

    def test_exception_values_that_are_not_allowed(self, leaves):
        captures, optics = leaves
        for light, message in (
            (LightSettings(noise_range=(0, 0.1)), "noise_range must be a number above 0, got 0"),
            (LightSettings(electrons=(9, 2)), "electrons must be least and largest, got 9 and 2"),
            (LightSettings(noise_error=float("nan")), "noise_error must be"),
        ):
            with pytest.raises(ValueError, match=message):
                NoisyCrops(captures, optics, 8, light)
        with pytest.raises(ValueError, match="the crop must not exceed the captures of 32 x 32 pixels, got 33"):
            NoisyCrops(captures, optics, 33)[0]
