"""Trained networks on linear light: they see what they were trained with, and depth comes back in metres."""

from __future__ import annotations

import math
import sys

import cv2
import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb
from torch import nn

import kornia_tidy
from kornia_tidy import SensorNoise, ThinLensCamera
from kornia_tidy.data import dead_leaves
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.capture_checks import MeasuredNoise, check_capture, least_softness
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.reconstruction.light_head import LightHead, UncertainReconstruction, reconstruct_light, with_noise_of
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.tasks import channels_of
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, build_optics, update_psfs
from tests.base import BaseTester
from tests.reconstruction.test_restored_over_field import CORNER, camera


class Passing(nn.Module):
    """Returns the image, and its red channel as inverse_depth."""

    def __init__(self, task):
        super().__init__()
        self.task = task

    def forward(self, image):
        maps = {"edof": image, "depth": image[:, :1], "joint": torch.cat([image[:, :1], image], 1)}[self.task]
        assert maps.shape[1] == channels_of(self.task)
        return maps


class Unsure(nn.Module):
    """Returns the image, and a depth that is 0 or 1 with equal chances."""

    def forward(self, image):
        return torch.cat([image[:, :2] * 0, image], 1)


def light_head(task, color_space=None, head=None, **settings):
    settings = SystemSettings(task=task, masks=1, window=23, color_space=color_space, **settings)
    return LightHead(TrainedSystem(build_optics(settings), head or Passing(task), settings, 0))


class TestLightHead(BaseTester):
    @pytest.mark.parametrize("color_space", ["srgb", "linear"])
    def test_feature_networks_see_the_space_they_were_trained_in(self, color_space):
        """Passed on as it is, the light comes out encoded, whichever space the network worked in."""
        head, light = light_head("edof", color_space), torch.rand(1, 3, 9, 8) * 1.4 - 0.2
        seen = []
        head.head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
        (image,) = head(light)
        clipped = light.clamp(0, 1)
        self.assert_close(image, linear_rgb_to_rgb(clipped))
        self.assert_close(seen[0], linear_rgb_to_rgb(clipped) if color_space == "srgb" else clipped)

    @pytest.mark.filterwarnings("ignore::kornia_tidy.psf.paper.AliasingWarning")
    def test_feature_the_paper_takes_light_for_light(self):
        head, light = light_head("edof", fidelity="paper"), torch.rand(1, 3, 9, 8)
        seen = []
        head.head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
        head(light)
        self.assert_close(seen[0], light)

    def test_feature_the_noise_is_told_to_a_network_that_takes_it(self):
        settings, light = SystemSettings(masks=1, window=23, head="tikhonov", sigma=0.002), torch.rand(1, 3, 40, 40)
        optics, head = build_optics(settings), build_head(settings)
        with torch.no_grad():
            update_psfs(head, optics)
        system = TrainedSystem(optics, head, settings, 0)
        capture = optics.encode(light)
        # The two encode light in other ways, 2e-7 apart, which the inverse amplifies by up to 1 / .003 at this noise.
        for noise, expected in ((None, 0.002), (0.03, 0.03)):
            self.assert_close(LightHead(system, noise)(light)[0], head(capture, expected), rtol=0, atol=1e-4)
        assert (head(capture, 0.03) - head(capture, 0.002)).abs().max() > 0.01

    def test_exception_noise(self):
        settings = SystemSettings(masks=1, window=23)
        system = TrainedSystem(build_optics(settings), Passing("edof"), settings, 0)
        with pytest.raises(ValueError, match="conditioned on it, and this one is not"):
            LightHead(system, 0.01)
        with pytest.raises(ValueError, match="noise must be positive and finite in units of full scale, got 0"):
            LightHead(system, 0.0)


class TestReconstructLight(BaseTester):
    @pytest.mark.parametrize("head", CLOSED_FORMS[::2])
    @torch.no_grad()
    def test_feature_behind_a_lens_the_psfs_of_the_place_restore_better_than_those_of_the_axis(self, head):
        """Near focus, at the corner of a single element, whose curvature defocuses it by 5 rad there."""
        sensor, near_focus = SensorNoise(0.002), ThinLensCamera(depth_range=(0.58, 0.61))
        optics = camera(field_center=CORNER, camera=near_focus, sensor=sensor, color_space="srgb")
        image = dead_leaves(96, 96, seed=1)[0]
        coded = optics(image, torch.full((1, 96, 96), 0.595), generator=torch.Generator().manual_seed(0))
        system = any_camera_system(optics, head=head)
        seen = []
        options = {"progress": lambda *counts: seen.append(counts)}
        restored = reconstruct_light(LightHead(system), optics.decode(coded), **options).image
        assert seen == [(1, 1)]
        lost = [
            float((x - image)[..., 16:-16, 16:-16].square().mean()) for x in (restored, system.head(coded[None])[0])
        ]
        assert lost[0] < lost[1]

    def test_exception_a_network_that_was_trained_is_for_no_other_camera(self):
        with pytest.raises(ValueError, match=r"head must be one of 'tikhonov', .*, got 'nafnet'"):
            any_camera_system(camera(), head="nafnet")

    def test_feature_depth_is_in_metres(self):
        """Linear colours, so that red light is inverse_depth: half is the focus distance of the default lens."""
        light = torch.tensor([0.0, 0.5, 1.0]).view(1, 1, 3)
        depth = reconstruct_light(light_head("depth", "linear"), light).depth
        self.assert_close(depth.flatten()[1:], torch.tensor([0.595, 0.2975]))
        assert math.isinf(depth.flatten()[0])

    def test_feature_stray_light_is_that_of_the_whole_picture(self):
        """In tiles, of which some are darker than others."""
        settings = SystemSettings(masks=1, window=9, stray_light="veil", head="tikhonov-bilateral")
        optics, head = build_optics(settings), build_head(settings)
        with torch.no_grad():
            update_psfs(head, optics)
        light = torch.rand(3, 30, 200, generator=torch.Generator().manual_seed(0)) * torch.linspace(0, 1, 200)
        seen = []
        light_head = LightHead(TrainedSystem(optics, head, settings, 0))
        found = reconstruct_light(light_head, light, memory_budget=1 << 20, progress=lambda *n: seen.append(n))
        told = MeasuredNoise(*head.closed_form.noise_model.tolist())
        light = check_capture(light, told, least_softness(head.closed_form.psfs)).light  # without outliers
        whole = head(optics.encode(light[None]))[0]
        assert len(seen) > 1
        # Roundings of float32, times the slope of sRGB in the dark, 12.92, and the filter's largest gain, 5.
        self.assert_close(found.image, whole, atol=12.92 * 5 * 10 * 2**-24, rtol=0)
        dark = head(optics.encode(light[None, ..., :60]))[0]
        assert (dark - whole[..., :60])[..., :30].abs().max() > 0.01

    def test_feature_pictures_at_the_same_time_have_copies_with_their_own_noise_and_stray_light(self, monkeypatch):
        settings = SystemSettings(masks=1, window=9, stray_light="veil", head="tikhonov-bilateral")
        optics, head = build_optics(settings), build_head(settings)
        with torch.no_grad():
            update_psfs(head, optics)
        light_head = LightHead(TrainedSystem(optics, head, settings, 0))
        ramp = torch.linspace(0, 1, 200)
        light = torch.rand(2, 3, 30, 200, generator=torch.Generator().manual_seed(0))
        pictures = light * torch.stack([ramp, 1 - ramp]).view(2, 1, 1, 200)

        def images(heads, progress=None):
            found = []
            for own, picture in zip(heads, pictures, strict=True):
                found.append(reconstruct_light(own, picture, memory_budget=2 << 20, progress=progress).image)
            return found

        alone = images([light_head, light_head])
        measured = sys.modules["kornia_tidy.reconstruction.receptive_field"]
        monkeypatch.setattr(measured, "_measure", lambda *_: pytest.fail("measured again"))
        first, second, third = (with_noise_of(light_head, None) for _ in range(3))
        between = images([first, second], lambda *_: images([third, third]))
        assert all(torch.equal(one, expected) for one, expected in zip(between, alone, strict=True))
        noisy = with_noise_of(light_head, SensorNoise(0.03))
        assert not torch.equal(images([noisy, noisy])[1], alone[1])
        assert torch.equal(images([light_head, light_head])[1], alone[1])
        assert noisy.head.closed_form.kernels is light_head.head.closed_form.kernels

    def test_feature_a_distribution_of_depth_tells_its_uncertainty(self):
        """Half a range on each side of the focus: from the near end, 0.2975 m, to infinity."""
        head = light_head("joint", "linear", Unsure(), depth_classes=2, refocus=2)
        result = reconstruct_light(head, torch.rand(3, 5, 6))
        assert isinstance(result, UncertainReconstruction)
        self.assert_close(result.depth, torch.full((1, 5, 6), 0.595))
        self.assert_close(result.relative_deviation, torch.full((1, 5, 6), 0.5))
        assert result.deviation.isinf().all()
        _, depth = kornia_tidy.reconstruct(np.full((4, 5), 77, np.uint8), head)
        assert depth.shape == (4, 5)

    def test_exception_names_the_shape_or_the_unit(self):
        with pytest.raises(ValueError, match=r"light must have shape \(3, H, W\) or \(1, H, W\), got \(2, 4, 4\)"):
            reconstruct_light(light_head("edof"), torch.rand(2, 4, 4))
        with pytest.raises(ValueError, match="light must be in parts of full scale, at most 16, got 255: divide by"):
            reconstruct_light(light_head("edof"), torch.full((3, 4, 4), 255.0))


class TestPictures(BaseTester):
    @pytest.mark.parametrize("kind", [np.uint8, np.uint16])
    def test_feature_a_network_that_passes_gives_the_picture_back(self, kind):
        picture = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (20, 30, 3), kind)
        image, depth = kornia_tidy.reconstruct(picture, light_head("joint"))
        assert image.dtype == kind
        assert depth.shape == (20, 30)
        assert np.abs(image.astype(int) - picture).max() <= (1 if kind is np.uint8 else 3)

    def test_feature_linear_pictures_come_back_encoded(self):
        picture = np.full((4, 4, 3), 32768, np.uint16)
        image, _ = kornia_tidy.reconstruct(picture, light_head("edof"), linear=True)
        assert abs(int(image[0, 0, 0]) - 65535 * 0.73536) < 3  # sRGB's encoding of 0.5

    def test_feature_grey_pictures_and_color_order(self):
        grey, _ = kornia_tidy.reconstruct(np.full((4, 5), 77, np.uint8), light_head("edof"))
        assert grey.shape == (4, 5, 3)
        blue = np.zeros((4, 4, 3), np.uint8)
        blue[..., 0] = 200
        assert cv2.split(kornia_tidy.reconstruct(blue, light_head("edof"))[0])[0].mean() == pytest.approx(200, abs=1)
