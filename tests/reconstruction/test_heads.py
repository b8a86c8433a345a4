"""Heads by name and by import path."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from kornia_tidy.choices import INVERSES
from kornia_tidy.reconstruction import ReconstructionHead, receptive_field
from kornia_tidy.reconstruction.heads import CLOSED_FORMS, HEADS, make_head
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics, load_trained, update_psfs
from kornia_tidy.training.average import MovingAverage
from tests.base import BaseTester

HERE = "tests.reconstruction.test_heads"
SETTINGS = SystemSettings(masks=1, window=9, fidelity="draft", width=4)


class Halving(nn.Module):
    """A network from outside, for images of even sides."""

    stride = 2

    def __init__(self, in_channels, out_channels, width=3):
        super().__init__()
        self.down = nn.Conv2d(in_channels, width, 2, stride=2)
        self.up = nn.Sequential(nn.Upsample(scale_factor=2), nn.Conv2d(width, out_channels, 3, padding=1))

    def forward(self, image):
        return self.up(self.down(image))


class Shrinking(nn.Conv2d):
    """Returns maps that are smaller than the image."""

    def __init__(self, in_channels, out_channels):
        super().__init__(in_channels, out_channels, 3)


def not_a_class(in_channels, out_channels):
    return nn.Conv2d(in_channels, out_channels, 1)


class TestMakeHead(BaseTester):
    @pytest.mark.parametrize("name", [*HEADS, f"{HERE}:Halving"])
    def test_smoke_every_head(self, name):
        if name in ("depth-anything-v2", "zoedepth"):
            pytest.importorskip("transformers", reason="published layers of baselines come from transformers")
        widths = {"midas-small": None, "depth-anything-v2": 64, "zoedepth": 64}
        head = make_head(name, 1, widths.get(name, 4))
        assert isinstance(head, ReconstructionHead)
        assert head(torch.rand(1, 3, 33, 40)).shape == (1, 1, 33, 40)

    def test_feature_a_network_from_outside_is_padded_to_its_stride(self):
        head = make_head(f"{HERE}:Halving", 2, 5)
        assert head.network.down.out_channels == 5
        assert head.stride == 2
        assert head(torch.rand(1, 3, 7, 9)).shape == (1, 2, 7, 9)
        assert receptive_field(head.eval()) == 1

    @pytest.mark.parametrize(
        ("name", "options", "sentence"),
        [
            ("nafnett", {}, "head must be one of .*, or the path of a class .*, got 'nafnett'"),
            (":Halving", {}, "head must be one of .* got ':Halving'"),
            ("os:", {}, "head must be one of .* got 'os:'"),
            ("tikhonov", {}, "the head 'tikhonov' has no network: make it by ClosedFormHead"),
            ("no.such_module:Net", {}, "the head 'no.such_module:Net' cannot be imported: No module named 'no'"),
            (f"{HERE}:Doubling", {}, "cannot be imported: module .* has no attribute 'Doubling'"),
            (f"{HERE}:not_a_class", {}, "must be a class of torch.nn.Module, got <function"),
            ("os:getcwd", {}, "must be a class of torch.nn.Module, got <built-in"),
            (f"{HERE}:Shrinking", {"width": 3}, r"Shrinking\(3, 1, width=3\) cannot be made: .*width"),
            ("plain", {"repeats": 2}, "repeats are for the head nafnet, got 2 for 'plain'"),
            ("midas-small", {"width": 3}, "'midas-small' takes 3 channels and no width, got 3 and width=3"),
            ("midas-small", {"in_channels": 19}, "takes 3 channels and no width, got 19 and width=None"),
        ],
    )
    def test_exception(self, name, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            make_head(name, 1, **options)

    def test_exception_maps_of_another_size(self):
        with pytest.raises(ValueError, match=r"Shrinking must return \(1, 1, 8, 8\), got \(1, 1, 6, 6\)"):
            make_head(f"{HERE}:Shrinking", 1)(torch.rand(1, 3, 8, 8))


class TestBuildHead(BaseTester):
    @pytest.mark.parametrize("name", [*CLOSED_FORMS, "nafnet", f"{HERE}:Halving"])
    def test_feature_a_checkpoint_brings_the_head_and_its_camera_back(self, name, tmp_path):
        settings = SETTINGS.replace(head=name, closed_form=name not in CLOSED_FORMS)
        optics, head = build_optics(settings), build_head(settings).eval()
        with torch.no_grad():
            update_psfs(head, optics)
        weights = {f"optics.{key}": value for key, value in optics.state_dict().items()}
        weights |= {f"head.{key}": value for key, value in head.state_dict().items()}
        write_state(tmp_path / "a", {"settings": settings.as_dict(), "state_dict": weights, "global_step": 3})
        system, capture = load_trained(tmp_path / "a"), torch.rand(1, 3, 24, 24)
        with torch.no_grad():
            self.assert_close(system.head(capture), head(capture))
            alone = build_head(settings).eval()  # without a camera
            alone.load_state_dict(head.state_dict())
            assert torch.equal(alone(capture), head(capture))

    @pytest.mark.parametrize("settings", [{"refocus": 3}, {"refocus": 3, "task": "joint", "depth_classes": 4}])
    def test_feature_the_filter_of_the_closed_form_is_that_of_the_settings(self, settings):
        for inverse in INVERSES:
            head = build_head(SETTINGS.replace(head="plain", closed_form=True, inverse=inverse, **settings))
            assert head.closed_form.inverse == inverse

    def test_feature_it_is_that_of_the_camera(self):
        """The PSFs of all colours, evenly spaced over depth, its noise and its encoding."""
        settings = SETTINGS.replace(head="tikhonov", sigma=0.004, color_space="linear")
        optics, head = build_optics(settings), build_head(settings)
        with torch.no_grad():
            update_psfs(head, optics)
            bank = optics.psf_bank(3, defocus=torch.linspace(*optics.camera.defocus_range, 11).tolist())
        self.assert_close(head.closed_form.psfs[0], bank.psfs.mean(0), atol=1e-6)
        capture = torch.rand(1, 3, 16, 16)
        self.assert_close(head(capture), head(capture, 0.004))
        assert not head.closed_form.encoded
        assert not head.closed_form.bilateral

    def test_feature_the_moving_average_takes_the_psfs(self):
        settings = SETTINGS.replace(head="plain", closed_form=True)
        head, capture = build_head(settings).eval(), torch.rand(1, 3, 16, 16)
        average = MovingAverage(head)
        with torch.no_grad():
            update_psfs(head, build_optics(settings))
            average.update(head)
            self.assert_close(average(capture), head(capture))
            update_psfs(head, build_optics(settings.replace(window=11, seed=1)))
            average.update(head)
            self.assert_close(average(capture), head(capture))
        copy.deepcopy(average)

    def test_exception_weights_of_another_number_of_layers(self, tmp_path):
        settings = SETTINGS.replace(head="plain", closed_form=True, refocus=3)
        head = build_head(settings)
        weights = {f"head.{key}": value for key, value in head.state_dict().items()}
        weights["head.closed_form.psfs"] = torch.zeros(2, 3, 9, 9)
        state = {"settings": settings.as_dict(), "state_dict": weights, "global_step": 3}
        write_state(tmp_path / "a", state)
        with pytest.raises(ValueError, match=r"closed_form.psfs is \(2, 3, 9, 9\), wanted \(3, 3, 0, 0\)"):
            load_trained(tmp_path / "a")
