"""Monocular depth networks as heads: sizes, normalisation, the affine fit, and the format of transformers."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from kornia_tidy import DefocusRange, ThinLensCamera
from kornia_tidy.reconstruction import reconstruct_tiled
from kornia_tidy.reconstruction.baselines import (
    MonocularDepth,
    fit_affine,
    load_depth_anything_v2,
    load_zoedepth,
    working_size,
)
from kornia_tidy.reconstruction.heads import make_head
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from tests.base import BaseTester

KINDS = {"depth-anything-v2": ("DepthAnythingForDepthEstimation", load_depth_anything_v2, 14, (0.485, 0.456, 0.406))}
KINDS["zoedepth"] = ("ZoeDepthForDepthEstimation", load_zoedepth, 32, (0.5, 0.5, 0.5))


class Red(nn.Module):
    """Returns the red channel of what it is given, and keeps it."""

    def forward(self, pixel_values):
        self.given = pixel_values
        return SimpleNamespace(predicted_depth=pixel_values[:, 0])


def red(metric=False, side=28, **options):
    return MonocularDepth(Red(), metric=metric, side=side, multiple=14, **options).eval()


PLAIN = {"mean": (0.0, 0.0, 0.0), "deviation": (1.0, 1.0, 1.0)}


@pytest.fixture(scope="module")
def transformers():
    return pytest.importorskip("transformers", reason="transformers is not installed (extra 'baselines')")


def tiny(name):
    """A small network whose random weights are large enough to tell pictures apart."""
    torch.manual_seed(1)
    head = make_head(name, 1, width=16).eval()
    with torch.no_grad():
        for parameter in head.network.parameters():
            parameter.copy_(0.2 * torch.randn_like(parameter))
        if name == "depth-anything-v2":
            head.network.head.conv3.bias.fill_(2.0)  # before the last ReLU
    head.side = 2 * head.multiple
    return head


class TestMonocularDepth(BaseTester):
    @pytest.mark.parametrize("size", [(28, 28), (30, 61), (100, 40), (5, 7), (1, 1)])
    def test_cardinality(self, size):
        head = red()
        assert head(torch.rand(2, 3, *size)).shape == (2, 1, *size)
        given = head.network.given.shape
        assert given[-2] % 14 == given[-1] % 14 == 0
        assert min(given[-2:]) == 28

    def test_feature_pictures_are_normalised_by_mean_and_deviation(self):
        head = red(mean=(0.1, 0.2, 0.3), deviation=(0.5, 0.25, 2.0))
        head(torch.tensor([0.6, 0.7, 0.9]).view(1, 3, 1, 1).expand(1, 3, 28, 42))
        self.assert_close(head.network.given, torch.tensor([1.0, 2.0, 0.3]).view(1, 3, 1, 1).expand(1, 3, 28, 42))

    def test_feature_a_metric_network_gives_the_inverse_depth_of_the_camera(self):
        camera = ThinLensCamera.for_scene((0.5, 4.0))
        metres = torch.linspace(0.5, 4.0, 28 * 28).view(1, 1, 28, 28)
        head = red(metric=True, **PLAIN).for_camera(camera)
        found = head(metres.expand(1, 3, 28, 28) / 1)
        self.assert_close(found, normalised_inverse_depth(camera, metres))

    def test_feature_a_fit_to_other_scenes_is_kept(self):
        image, valid = torch.rand(2, 3, 28, 28), torch.rand(2, 1, 28, 28) > 0.3
        truth = 0.4 * image[:, :1] - 0.1
        truth[~valid] = torch.nan
        head = red(**PLAIN).fit(image, truth, valid)
        self.assert_close(torch.stack([head.scale, head.shift]), torch.tensor([0.4, -0.1]))
        head.fit(image, truth, valid)  # of a head that is fitted already
        self.assert_close(torch.stack([head.scale, head.shift]), torch.tensor([0.4, -0.1]))
        other = red(**PLAIN)
        other.load_state_dict(head.state_dict())
        picture = torch.rand(1, 3, 28, 28)
        self.assert_close(other(picture), 0.4 * picture[:, :1] - 0.1)

    def test_exception_scale_of_a_relative_network_or_a_camera_without_metres(self):
        with pytest.raises(ValueError, match="has no metric scale: fit it"):
            red().for_camera(ThinLensCamera())
        with pytest.raises(TypeError, match=r"camera must be a ThinLensCamera, .*, got a DefocusRange"):
            red(metric=True).for_camera(DefocusRange(-20, 20))

    def test_exception_tiles(self):
        with pytest.raises(ValueError, match="cannot be tiled: MonocularDepth sees the whole image"):
            reconstruct_tiled(nn.Sequential(red()).eval(), torch.rand(1, 3, 60, 60), tile=28)

    def test_gradcheck(self):
        self.gradcheck(red(**PLAIN).double(), (torch.rand(1, 3, 9, 12),))

    @pytest.mark.parametrize(
        ("size", "expected"), [((480, 640), (518, 686)), ((640, 480), (686, 518)), ((9, 9), (518, 518))]
    )
    def test_feature_working_sizes_of_depth_anything(self, size, expected):
        assert working_size(*size, 518, 14) == expected


class TestFitAffine(BaseTester):
    def test_feature_least_squares_of_each_image(self):
        rng = np.random.default_rng(2)
        estimate, truth = rng.normal(size=(2, 3, 1, 5, 7))
        valid = rng.random((3, 1, 5, 7)) > 0.4
        scale, shift = fit_affine(*map(torch.from_numpy, (estimate, np.where(valid, truth, np.nan), valid)))
        for i in range(3):
            known = valid[i]
            columns = np.stack([estimate[i][known], np.ones(known.sum())], 1)
            expected = np.linalg.lstsq(columns, truth[i][known], rcond=None)[0]
            self.assert_close(torch.stack([scale[i, 0, 0, 0], shift[i, 0, 0, 0]]), torch.from_numpy(expected))

    def test_feature_constant_estimates_and_images_without_truth(self):
        estimate = torch.full((2, 1, 2, 2), 3.0)
        truth = torch.tensor([1.0, 2.0, 3.0, 6.0]).view(1, 1, 2, 2).expand(2, 1, 2, 2)
        valid = torch.tensor([True, False]).view(2, 1, 1, 1).expand(2, 1, 2, 2)
        scale, shift = fit_affine(estimate, truth, valid)
        assert scale.flatten().tolist() == [0, 0]
        assert shift.flatten().tolist() == [3, 0]


class TestByName(BaseTester):
    @pytest.mark.parametrize("name", KINDS)
    def test_exception_without_transformers(self, name, monkeypatch):
        monkeypatch.setitem(sys.modules, "transformers", None)
        with pytest.raises(ImportError, match=rf"{name} needs transformers: pip install 'kornia-tidy\[baselines\]'"):
            make_head(name, 1)

    @pytest.mark.parametrize("name", KINDS)
    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"out_channels": 3}, "takes 3 channels and estimates only depth, 1 map, got 3 and 3"),
            ({"out_channels": 1, "in_channels": 8}, "got 8 and 1"),
            ({"out_channels": 1, "width": 100}, "width must be a multiple of 8, above 64 of 64, got 100"),
        ],
    )
    def test_exception_other_shapes(self, name, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            make_head(name, **options)
