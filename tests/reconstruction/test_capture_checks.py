"""Captures as they come: outliers, noise, JPEG, encoding, each made here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from kornia_tidy import DefocusRange, NoMask, SensorNoise, TiDyOptics
from kornia_tidy.data import photographic_leaves
from kornia_tidy.reconstruction import RuledClosedForm
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.capture_checks import (
    JPEG,
    JPEG_NOISE,
    MeasuredNoise,
    blockiness,
    check_capture,
    least_softness,
    measure_noise,
    repair_bands,
    repair_outliers,
)
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.trained import closed_form_bank
from tests.base import BaseTester
from tests.reconstruction.test_ruled_closed_form import painted


def capture(electrons=20_000.0, side=320, seed=3):
    """Blurred light of a painted scene by a sensor of 2.4 electrons read noise, (3, H, W)."""
    image, _ = photographic_leaves(side + 4, side + 4, seed=seed)
    light = torch.nn.functional.avg_pool2d(rgb_to_linear_rgb(image[None]), 5, 1)
    sensor = SensorNoise(2.4 / electrons, full_well=electrons)
    return sensor(light, generator=torch.Generator().manual_seed(0))[0], sensor


def told(sensor):
    return MeasuredNoise(sensor.sigma**2, 1 / sensor.full_well)


def with_outliers(light, share):
    drawn = torch.rand(light.shape, generator=torch.Generator().manual_seed(5))
    return torch.where(drawn < share / 2, 1.0, torch.where(drawn < share, 0.0, light)), drawn < share


class TestRepairOutliers(BaseTester):
    def test_feature_hot_and_dead_pixels_are_found_and_no_others(self):
        light, sensor = capture()
        marked, places = with_outliers(light, 1e-3)
        repaired = repair_outliers(marked, told(sensor))
        changed = repaired.light != marked
        far = (marked - light).abs() > 0.1  # a dead pixel in the dark is none that shows
        assert (changed & places & far).sum() >= 0.95 * (places & far).sum()
        assert (changed & ~places).sum() <= 3
        before, after = ((one - light).square().mean() for one in (marked, repaired.light))
        assert after < 0.03 * before

    def test_feature_an_undisturbed_capture_stays(self):
        for electrons in (300.0, 100_000.0):
            light, sensor = capture(electrons)
            assert repair_outliers(light, told(sensor)).count <= 3

    def test_feature_rows_that_are_worked_on_apart_are_the_whole(self):
        light, sensor = capture(side=520)
        marked, _ = with_outliers(light, 1e-3)
        whole, turned = (repair_outliers(part, told(sensor)).light for part in (marked, marked.transpose(1, 2)))
        assert torch.equal(whole, turned.transpose(1, 2))

    @pytest.mark.parametrize(("colors", "count"), [((0, 1, 2), 0), ((1,), 1)])
    def test_feature_points_of_the_scene_stay_and_those_of_one_color_do_not(self, colors, count):
        psf = torch.tensor([[0.0, 0.02, 0.0], [0.02, 0.92, 0.02], [0.0, 0.02, 0.0]])  # behind a sharp lens
        light = torch.full((3, 9, 9), 0.1)
        light[list(colors), 3:6, 3:6] += 0.8 * psf
        assert repair_outliers(light, MeasuredNoise(1e-6, 0.0), least_softness(psf)).count == count
        assert repair_outliers(light, MeasuredNoise(1e-6, 0.0)).count == len(colors)  # behind an unknown lens
        stuck = torch.full((3, 9, 9), 0.1)
        stuck[:, 4, 4] = 1.0
        assert repair_outliers(stuck, MeasuredNoise(1e-6, 0.0), least_softness(psf)).count == 3

    def test_feature_corners_have_neighbours(self):
        light = torch.full((1, 4, 4), 0.2)
        light[0, 0, 0], light[0, 3, 1] = 1.0, 0.0
        repaired = repair_outliers(light, MeasuredNoise(1e-6, 0.0))
        assert repaired.count == 2
        assert (repaired.light == 0.2).all()


class TestRepairBands(BaseTester):
    @pytest.mark.parametrize("rows", [True, False])
    @pytest.mark.parametrize("size", [0.002, 0.008])
    def test_feature_bands_are_levelled(self, size, rows):
        light, sensor = capture()
        bands = size * torch.randn(light.shape[-1], generator=torch.Generator().manual_seed(2))
        marked = light + (bands[:, None] if rows else bands)
        found = repair_bands(marked, told(sensor).std(float(light.mean())))
        assert found.size == pytest.approx(size, rel=0.2)
        assert (found.light - light).square().mean() < 0.4 * bands.square().mean()

    def test_feature_an_undisturbed_capture_stays(self):
        for electrons in (300.0, 100_000.0):
            light, sensor = capture(electrons)
            assert repair_bands(light, told(sensor).std(float(light.mean()))).light is light

    def test_feature_clipped_pixels_stay(self):
        light, sensor = capture()
        marked = (light + 0.01 * torch.randn(light.shape[-1], generator=torch.Generator().manual_seed(2))).clamp(0, 1)
        marked[:, :40, :40] = 1.0
        found = repair_bands(marked, told(sensor).std(float(light.mean())))
        assert found.size > 0
        assert (found.light[:, :40, :40] == 1).all()

    def test_feature_stripes_of_a_scene_stay(self):
        """Optics blur them: from row to row they change little."""
        light = 0.3 + 0.002 * torch.randn(3, 200, 200, generator=torch.Generator().manual_seed(0))
        for period in (5, 8, 20):
            stripes = 0.02 * (2 * np.pi / period * torch.arange(200.0)).sin()
            assert repair_bands(light + stripes[:, None], 0.002).size == 0

    def test_feature_too_small(self):
        light = 0.5 + 0.1 * torch.randn(1, 200, generator=torch.Generator().manual_seed(0)).expand(3, 63, 200)
        assert repair_bands(light, 0.01).size == 0
        assert repair_bands(torch.cat([light, light[:, :1]], 1), 0.01).size > 0


def jpeg(light, quality):
    pixels = (linear_rgb_to_rgb(light[None])[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    read = cv2.imdecode(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    return rgb_to_linear_rgb(torch.from_numpy(read).permute(2, 0, 1)[None].float() / 255)[0]


class TestMeasureNoise(BaseTester):
    @pytest.mark.parametrize("electrons", [300.0, 3000.0, 50_000.0])
    def test_feature_within_a_tenth_of_the_sensor(self, electrons):
        light, sensor = capture(electrons)
        found = measure_noise(light)
        level = float(light.mean())
        assert found.std(level) == pytest.approx(float(sensor.std(torch.tensor(level))), rel=0.1)

    def test_feature_too_little_to_measure(self):
        assert measure_noise(torch.rand(3, 9, 200)) is None
        assert measure_noise(torch.ones(3, 200, 200)) is None


class TestCheckCapture(BaseTester):
    def test_feature_nothing_to_tell(self):
        light, sensor = capture()
        checked = check_capture(light, told(sensor))
        assert not [note for note in checked.notes if "outliers" not in note]

    def test_feature_noise_that_is_told_too_small(self):
        light, sensor = capture(1000.0)
        (note,) = check_capture(light, MeasuredNoise(*(0.04 * part for part in told(sensor)))).notes
        assert "5 times the stated noise: --noise 0.0" in note
        assert not check_capture(light, MeasuredNoise(*(3 * part for part in told(sensor)))).notes

    @pytest.mark.parametrize("quality", [80, 92])
    def test_feature_jpeg(self, quality):
        light, sensor = capture()
        compressed = jpeg(light, quality)
        checked = check_capture(compressed, told(sensor))
        assert any("JPEG" in note for note in checked.notes)
        assert not any("outliers" in note for note in checked.notes)  # though the squares of least variance have none
        assert checked.least_noise > float(sensor.std(light).mean())
        assert check_capture(light, told(sensor)).least_noise == 0
        assert blockiness(compressed[:, 3:, 5:]) > JPEG > blockiness(light)  # wherever the blocks begin
        of_scene = sensor(jpeg(light, 50)[None], generator=torch.Generator().manual_seed(1))[0]
        assert blockiness(of_scene) > JPEG
        assert check_capture(of_scene, told(sensor)).least_noise == 0  # not the capture: its noise is whole

    @pytest.mark.takes_seconds
    def test_feature_jpeg_counts_as_noise_unless_more_is_told(self):
        optics = TiDyOptics(fidelity="draft", sensor=SensorNoise(2.4 / 20_000, full_well=20_000.0))
        system = any_camera_system(optics)
        compressed = jpeg(capture(side=128)[0], 80)
        more = [reconstruct_light(LightHead(system, noise), compressed).image for noise in (None, 0.02)]
        form = next(part for part in system.head.modules() if isinstance(part, RuledClosedForm))
        form.in_differences = 0.0
        found = reconstruct_light(LightHead(system, JPEG_NOISE), compressed).image
        self.assert_close(more[0], found)
        assert (more[1] - found).abs().max() > 1e-3

    def test_feature_jpeg_does_not_hide_the_detail_of_a_scene(self):
        """A picture of a photograph's spectrum: white noise of that level would take most of it for noise."""
        optics = TiDyOptics(NoMask(), DefocusRange(-1.0, 1.0), sensor=None, fidelity="draft")
        light = (0.4 + 0.3 * painted(160, 1)[0].float()).clamp(0, 1).expand(3, -1, -1)
        seen = optics(linear_rgb_to_rgb(light[None]), torch.full((1, 1, 160, 160), 0.5))
        compressed = linear_rgb_to_rgb(jpeg(optics.decode(seen)[0], 92)[None])
        form = RuledClosedForm(7)
        form.set_psfs(closed_form_bank(optics, 7))
        true, white = (float(form.settings_of(*one).detail) for one in ((seen, 1e-4), (compressed, JPEG_NOISE)))
        form.in_differences = 0.0
        found = float(form.settings_of(compressed, JPEG_NOISE).detail)
        assert white < 0.5 * true
        assert true < found < 2 * true

    def test_feature_encoded_light(self):
        light, sensor = capture()
        notes = check_capture(linear_rgb_to_rgb(light[None])[0], told(sensor)).notes
        assert any("its noise falls with light" in note for note in notes)

    def test_feature_dead_pixels_are_no_blocks(self):
        light, sensor = capture(50_000.0, side=200)
        smooth = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(light[None], (4,) * 4, "replicate"), 9, 1)
        seen = sensor(smooth, generator=torch.Generator().manual_seed(0))[0]
        dead = torch.rand(light.shape, generator=torch.Generator().manual_seed(4)) < 3e-3
        marked = torch.where(dead, 0.0, seen)
        assert blockiness(marked) > JPEG
        checked = check_capture(marked, told(sensor))
        assert checked.least_noise == 0
        assert all("outliers" in note for note in checked.notes)

    def test_feature_bands_are_told(self):
        light, sensor = capture()
        bands = 0.004 * torch.randn(light.shape[-2], 1, generator=torch.Generator().manual_seed(2))
        (note,) = (note for note in check_capture(light + bands, told(sensor)).notes if "outliers" not in note)
        assert note.startswith("its rows differed by 0.00")
        (note,) = (note for note in check_capture(light + bands.T, told(sensor)).notes if "outliers" not in note)
        assert note.startswith("its columns differed by 0.00")

    def test_feature_a_tone_curve_is_told(self):
        light, sensor = capture()
        encoded = linear_rgb_to_rgb(light[None])
        toned = rgb_to_linear_rgb(encoded.square() * (3 - 2 * encoded))[0]
        for stated in (told(sensor), None):
            assert any("as behind a tone curve" in note for note in check_capture(toned, stated).notes)
            assert not any("as behind a tone curve" in note for note in check_capture(light, stated).notes)

    def test_feature_reconstruction_repairs_and_tells(self):
        optics = TiDyOptics(fidelity="draft", sensor=SensorNoise(2.4 / 20_000, full_well=20_000.0))
        light, _ = capture(side=128)
        marked, _ = with_outliers(light, 2e-3)
        head = LightHead(any_camera_system(optics))
        clean, found = (reconstruct_light(head, one) for one in (light, marked))
        (note,) = (note for note in found.notes if "outliers" in note)
        assert int(note.split()[0]) >= 60
        assert (found.image - clean.image).square().mean() < 1e-3

    def test_exception_a_camera_without_a_sensor_has_no_noise(self):
        with pytest.raises(ValueError, match="the camera has no sensor: give sensor="):
            any_camera_system(TiDyOptics(fidelity="draft", sensor=None))
