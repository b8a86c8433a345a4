"""Bursts: light and noise counted, against closed forms, so that they can be compared with time averaging fairly."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import DwellTimes, Fidelity, LearnableDwellTimes, PixelwiseMask, SensorNoise, Switching, TiDyOptics
from kornia_tidy.camera.burst import burst, burst_shares
from kornia_tidy.optics import Lens
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=10.0, stray_light="discard")


def camera(masks=3, sensor=None, modulator=None, **options) -> TiDyOptics:
    options = {"fidelity": SMALL, "color_space": "linear", **options}
    return TiDyOptics(PixelwiseMask(masks), modulator=modulator, sensor=sensor, **options)


def scene(dtype=torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(2, 3, 24, 20, dtype=dtype), 0.3 + torch.rand(2, 1, 24, 20, dtype=dtype)


class TestBurst(BaseTester):
    def test_exception(self):
        with pytest.raises(ValueError, match=r"2 pauses of dead_time = 50 ms must be shorter .* 100 ms, got 100 ms"):
            burst(camera(), *scene(), dead_time=50e-3)
        with pytest.raises(ValueError, match="must be shorter than the exposure"):
            burst_shares(torch.ones(3) / 3, dead_time=-1e-3, exposure=0.1)
        with pytest.raises(ValueError, match="switching takes the whole exposure"):
            burst(camera(modulator=Switching(50e-3)), *scene())
        with pytest.raises(TypeError, match=r"optics must be a camera such as TiDyOptics.*, got the number 5"):
            burst(5, *scene())

    def test_feature_shots_behind_a_lens_see_the_nodes_of_their_mask(self):
        lens = Lens.named("single-50mm", 17.6, 0.595)
        fine = Fidelity(window=9, layer_spacing=20.0, field_tolerance=1e-2)
        optics = camera(camera=lens.camera(8e-6), lens=lens, fidelity=fine).requires_grad_(False)
        image, depth = torch.rand(1, 3, 96, 96), torch.full((1, 1, 96, 96), 0.8)
        alone = optics.through_moment(1)
        assert alone.psf_model.field_of((96, 96)).nodes != optics.psf_model.field_of((96, 96)).nodes
        assert torch.allclose(burst(optics, image, depth)[:, 1], alone(image, depth) / 3, rtol=1e-6, atol=0)

    def test_cardinality(self):
        image, depth = scene()
        assert burst(camera(), image, depth).shape == (2, 3, 3, 24, 20)
        assert burst(camera(1), image[0], depth[0], dead_time=5.0).shape == (1, 3, 24, 20)
        assert burst(camera(border="valid"), image, depth).shape == (2, 3, 3, 16, 12)

    def test_feature_without_noise_the_shots_add_up_to_the_exposure_less_the_pauses(self):
        optics, (image, depth) = camera(modulator=DwellTimes((1, 2, 3))), scene(torch.float64)
        with torch.no_grad():
            shots, averaged = burst(optics, image, depth, dead_time=7e-3), optics(image, depth)
        self.assert_close(shots.sum(1), averaged * (1 - 2 * 7e-3 / 0.1), rtol=0, atol=1e-7)

    def test_feature_photons_counted_and_lost_are_those_of_the_closed_form(self):
        """Electrons of a white scene: mean and variance, of the exposure and of each shot, and what pauses lose."""
        well, read, dark, dead, masks = 5000.0, 6.0, 40.0, 5e-3, 4
        sensor = SensorNoise(read / well, full_well=well, dark=dark, clip=False)
        optics = camera(masks, sensor, fidelity=SMALL.replace(stray_light="renormalize"))
        image, depth = torch.full((4, 3, 96, 96), 0.5), torch.full((4, 1, 96, 96), 0.7)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            once = well * optics(image, depth, generator=generator)
            shots = well * burst(optics, image, depth, dead_time=dead, generator=generator)
        share = (1 - (masks - 1) * dead / 0.1) / masks
        pixels = once.numel()
        for electrons, expected, variance in (
            (once, 2500, 2500 + dark + read**2),
            *((shots[:, k], 2500 * share, (2500 + dark) * share + read**2) for k in range(masks)),
            (shots.sum(1), 2500 * 0.85, (2500 + dark) * 0.85 + masks * read**2),
        ):
            assert abs(float(electrons.double().mean()) - expected) < 5 * (variance / pixels) ** 0.5
            assert float(electrons.double().var()) == pytest.approx(variance, rel=5 * (2 / pixels) ** 0.5)

    def test_feature_a_generator_repeats_it(self):
        optics, sample = camera(sensor=SensorNoise(0.01)), scene()
        runs = [burst(optics, *sample, generator=torch.Generator().manual_seed(1)) for _ in range(2)]
        assert torch.equal(*runs)
        assert not torch.equal(runs[0][:, 0] - runs[0][:, 1], torch.zeros_like(runs[0][:, 0]))

    def test_feature_shots_are_linear_light_whatever_the_camera_encodes(self):
        image, depth = scene()
        linear, srgb = camera(), camera(color_space="srgb")
        srgb.masks = linear.masks
        self.assert_close(burst(srgb, linear_to_srgb(image), depth), burst(linear, image, depth), atol=1e-5)

    def test_feature_gradients_reach_masks_and_dwell_times(self):
        optics = camera(2, modulator=LearnableDwellTimes((1, 1)))
        burst(optics, *scene(), dead_time=1e-3).square().mean().backward()
        assert bool((optics.masks.phase.grad.abs().amax((1, 2)) > 0).all())
        assert float(optics.modulator.logits.grad.abs().max()) > 0

    def test_feature_depths_out_of_range_are_warned_about_once(self):
        optics, (image, depth) = camera(), scene()
        with pytest.warns(UserWarning, match="beyond the camera's range") as caught:
            burst(optics, image, depth * 0.2)
        assert len(caught) == 1
        assert optics.clamped_pixels == depth.numel()


def linear_to_srgb(light: torch.Tensor) -> torch.Tensor:
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)
