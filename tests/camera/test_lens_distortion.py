"""Distortion and lateral colour: blobs must land where the lens's chief rays do."""

from __future__ import annotations

import json
import math

import pytest
import torch
from torch import Tensor

from kornia_tidy import NoMask, TiDyOptics
from kornia_tidy.camera import distorted
from kornia_tidy.optics import Lens, Spectrum
from tests.base import BaseTester, shared

PITCH = 8e-6
NAMES = ("double-gauss-50mm", "triplet-50mm", "single-50mm")


def camera(lens: Lens, **parts: object) -> TiDyOptics:
    return TiDyOptics(NoMask(23), lens.camera(PITCH), lens=lens, sensor=None, fidelity="draft", **parts)


def blob(y: float, x: float, size: tuple[int, int], center: tuple[float, float], sigma: float = 2.5) -> Tensor:
    """A Gaussian at a place in pixels from the axis, in a picture whose middle lies at the center, (1, H, W)."""
    rows, columns = (torch.arange(n) - (n - 1) / 2 + c for n, c in zip(size, center, strict=True))
    return torch.exp(-((rows[:, None] - y) ** 2 + (columns - x) ** 2) / (2 * sigma**2))[None].double()


def centroid(plane: Tensor, center: tuple[float, float]) -> Tensor:
    rows, columns = (torch.arange(n) - (n - 1) / 2 + c for n, c in zip(plane.shape, center, strict=True))
    return torch.stack([(plane.sum(1) * rows).sum(), (plane.sum(0) * columns).sum()]) / plane.sum()


class TestDistorted(BaseTester):
    @pytest.mark.parametrize("name", NAMES)
    def test_feature_light_lands_where_chief_rays_do_in_each_colour(self, name):
        """To a fiftieth of a pixel, which bilinear interpolation of a Gaussian costs, of up to 1.6 px."""
        lens = Lens.named(name, 17.6, 0.595)
        optics, center, at = camera(lens), (470.0, 520.0), torch.tensor([480.3, 531.8], dtype=torch.float64)
        image = blob(*at.tolist(), (48, 48), center).expand(3, -1, -1)
        seen, _ = distorted(optics, image, torch.ones(1, 48, 48), field_center=center)
        pinhole = float(at.norm()) * PITCH
        height = torch.tensor([pinhole], dtype=torch.float64)
        for _ in range(5):  # the distortion is told at the height where light lands
            height = pinhole * (1 + lens.distortion(height))
        for channel, wavelength in enumerate((610e-9, 530e-9, 470e-9)):
            landed = height + lens.lateral_colour(height, wavelength)
            expected = at * landed / pinhole
            self.assert_close(centroid(seen[channel], center), expected, rtol=0, atol=0.02)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("name", NAMES)
    def test_feature_light_lands_where_an_independent_tracer_says(self, name):
        """At a third, two thirds and all of the field, in each colour; without the warp up to 2.2 px beside it."""
        tabled = name.removesuffix("-50mm").replace("-", "_")
        known = json.loads(shared("lenses/distortion.json").read_text())[f"{tabled} s=595.0"]
        lens = Lens.named(name, 17.6, 0.595, field=7.5e-3)
        for part in ("0.333", "0.667", "1.000"):
            height, row = 6.784e-3 * float(part), known[part]
            pinhole = height / (1 + row["distortion_percent"] / 100) / PITCH / math.sqrt(2)
            center = (round(pinhole), round(pinhole))
            image = blob(pinhole, pinhole, (64, 64), center).expand(3, -1, -1)
            seen, _ = distorted(camera(lens), image, torch.ones(1, 64, 64), field_center=center)
            for channel, colour in enumerate(("610", "", "470")):
                lateral = row["lateral_um"].get(colour, 0.0) * 1e-6
                landed = torch.full((2,), (height + lateral) / PITCH / math.sqrt(2), dtype=torch.float64)
                self.assert_close(centroid(seen[channel], center), landed, rtol=0, atol=0.02)

    def test_feature_seidel_distortion_in_closed_form(self):
        """5 % at a height of 4 mm, growing with the square of the height."""
        lens = Lens.from_seidel(50e-3, 17.6, 0.595, 4e-3, distortion=0.05)
        optics, places = camera(lens, spectrum=Spectrum.monochrome()), [(0.0, 150.0), (-350.0, 250.0), (0.0, 0.0)]
        for y, x in places:
            seen, _ = distorted(optics, blob(y, x, (64, 64), (y, x)), torch.ones(1, 64, 64), (y, x))
            pinhole = torch.tensor([y, x], dtype=torch.float64)
            landed = pinhole.clone()
            for _ in range(20):
                landed = pinhole * (1 + 0.05 * float(landed.norm() * PITCH / 4e-3) ** 2)
            self.assert_close(centroid(seen[0], (y, x)), landed, rtol=0, atol=0.05)

    def test_feature_depth_moves_with_green_light_and_keeps_its_values(self):
        lens = Lens.from_seidel(50e-3, 17.6, 0.595, 4e-3, distortion=0.05)
        depth = torch.full((1, 1, 96, 96), 2.0)
        depth[..., 48:, 48:] = 0.5
        _, seen = distorted(camera(lens), torch.rand(1, 3, 96, 96), depth, field_center=(250.0, 250.0))
        assert set(seen.unique().tolist()) == {0.5, 2.0}
        edges = [int((part[0, 0, -1] == 0.5).sum()) for part in (depth, seen)]
        assert edges[0] != edges[1]

    def test_feature_a_lens_without_distortion_leaves_the_scene(self):
        lens = Lens.from_seidel(50e-3, 17.6, 0.595, 4e-3, coma=1.0)
        image, depth = torch.rand(2, 3, 4, 800), 1 + torch.rand(1, 1, 4, 800)
        seen, there = distorted(camera(lens), image, depth, field_center=[(100.0, -50.0), (0.0, 0.0)])
        self.assert_close(seen, image, rtol=0, atol=1e-4)
        assert torch.equal(there, depth.expand(2, -1, -1, -1))

    def test_gradcheck(self):
        optics = camera(Lens.from_seidel(50e-3, 17.6, 0.595, 4e-3, distortion=0.05))
        image, depth = torch.rand(1, 3, 9, 9, dtype=torch.float64), torch.ones(1, 1, 9, 9)
        self.gradcheck(lambda x: distorted(optics, x, depth, field_center=(200.0, 100.0))[0], (image,))

    @pytest.mark.parametrize(
        ("image", "depth", "center", "error", "message"),
        [
            (torch.ones(3, 8, 8), torch.ones(1, 8, 9), None, ValueError, "depth must have one map for each image"),
            (torch.ones(2, 8, 8), torch.ones(1, 8, 8), None, ValueError, "image must have 3 channels"),
            (torch.ones(3, 8, 8), torch.ones(1, 8, 8), 5.0, TypeError, "field_center must be two numbers"),
            (torch.ones(3, 8, 8, dtype=torch.uint8), torch.ones(1, 8, 8), None, TypeError, "image must be"),
        ],
    )
    def test_exception_one_sentence(self, image, depth, center, error, message):
        optics = camera(Lens.named("single-50mm", 17.6, 0.595))
        with pytest.raises(error, match=message):
            distorted(optics, image, depth, center)

    def test_exception_an_ideal_lens(self):
        with pytest.raises(ValueError, match="distortion needs a camera with a lens, got none"):
            distorted(TiDyOptics(), torch.ones(3, 8, 8), torch.ones(1, 8, 8))
