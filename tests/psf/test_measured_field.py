"""PSFs measured at several places of the picture, in captures and in restoration."""

from __future__ import annotations

import math

import pytest
import torch
from safetensors.torch import load_file, save_file

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, Spectrum, TiDyOptics
from kornia_tidy.augmentation import LinearCamera
from kornia_tidy.psf import FieldBank, PSFBank
from kornia_tidy.psf.measured_field import place_weights
from kornia_tidy.reconstruction import Wiener, restored_over_field
from kornia_tidy.render import render
from tests.base import BaseTester

SETTINGS = Fidelity(window=17, layer_spacing=10.0, field_tolerance=5e-3)
GRID = [(y, x) for y in (-100.0, 0.0, 100.0) for x in (-140.0, 0.0, 140.0)]


def camera(**parts) -> TiDyOptics:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(3))
    parts = {"spectrum": Spectrum.monochrome(), "fidelity": SETTINGS, "sensor": None, "color_space": "linear", **parts}
    return TiDyOptics(masks, **parts)


def measured(places=GRID, center=(440.0, 500.0), light=None) -> FieldBank:
    """A single element's PSFs as a laboratory would measure them: place by place, each scaled to one."""
    with torch.no_grad():
        there = [(y + center[0], x + center[1]) for y, x in places]
        seen = camera(lens="single-50mm").psf_bank(field=there)
    banks = [PSFBank.from_measured(seen.at(i).psfs, seen.defocus) for i in range(len(places))]
    return FieldBank.from_measured(banks, places, seen.light.mean((1, 2)).tolist() if light is None else light)


def scene(height=40, width=56) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    depth = 1 / (0.2 + 3 * torch.rand(1, 1, height // 8, width // 8, generator=generator))
    image = torch.rand(1, 1, height, width, generator=generator)
    return image, depth.repeat_interleave(8, 2).repeat_interleave(8, 3)


class TestPlaceWeights(BaseTester):
    @pytest.mark.parametrize(
        "places", [GRID, GRID[:1], GRID[:3], [(0.0, 3.0), (50.0, 1.0), (7.0, -60.0), (31.0, 20.0)]]
    )
    def test_feature_exact_at_the_places_and_of_planes(self, places):
        """One place, places on a line and places anywhere."""
        known = torch.tensor(places, dtype=torch.float64)
        self.assert_close(place_weights(known, places), torch.eye(len(places)).double(), rtol=0, atol=1e-9)
        inside = known.mean(0)[None]
        weights = place_weights(known, inside.tolist())
        self.assert_close(weights.sum(1), torch.ones(1).double())
        self.assert_close(weights @ known, inside, rtol=0, atol=1e-9)


class TestMeasuredField(BaseTester):
    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    @torch.no_grad()
    def test_feature_pixels_see_the_psfs_of_their_places(self, compositing):
        """At a measured place those that were measured; between them, those of the lens, as nearly as a spline."""
        bank, (image, depth) = measured(light=[1.0 - 0.01 * i for i in range(9)]), scene(208, 296)
        optics = camera(compositing=compositing).with_bank(bank)
        seen, center = optics(image, depth), [(side - 1) / 2 for side in image.shape[-2:]]
        for place, error in ((GRID[4], 1e-3), (GRID[8], 1e-3), ((50.0, -70.0), 1e-3)):
            own = optics.psf_bank(field=[place])
            pixel = [int(c + p) for c, p in zip(center, place, strict=True)]
            weights = bank.field.new_tensor(place) == bank.field
            if bool(weights.all(1).any()):
                self.assert_close(own.psfs[0], bank.psfs[int(weights.all(1).nonzero())], rtol=0, atol=1e-6)
            alone = PSFBank(own.psfs[0], own.defocus, own.energy[0])
            if compositing == "occlusion":
                alone = alone.with_tails() if optics.psf_model.measured_cut else alone
            expected = render(image, optics.camera.defocus(depth), alone, compositing=compositing, border=optics.border)
            expected = expected * own.light[0, 0, 0] if compositing == "occlusion" else expected
            assert float((expected - seen)[0, 0, pixel[0], pixel[1]].abs()) < error

    @torch.no_grad()
    def test_feature_nearer_to_the_lens_than_one_place(self):
        (image, depth), center = scene(208, 296), (440.0, 500.0)
        real = camera(lens="single-50mm", field_center=center)(image, depth)
        real = real / real.mean()
        seen = [camera().with_bank(bank)(image, depth) for bank in (measured(), measured(GRID[4:5]))]
        wrong = [float((x / x.mean() - real).square().mean().sqrt()) for x in seen]
        assert wrong[0] < 0.2 * wrong[1]

    @torch.no_grad()
    def test_feature_restored_by_the_psfs_of_the_place(self):
        """A capture through the corner of a single element; each tile by what was measured there, or at the middle."""
        bank, (image, depth) = measured(), scene(208, 296)
        image = torch.nn.functional.avg_pool2d(image, 3, 1, 1)
        depth = torch.full_like(depth, 0.55)
        capture = camera(lens="single-50mm", field_center=(440.0, 500.0))(image, depth)
        capture = capture + 1e-3 * torch.randn(capture.shape, generator=torch.Generator().manual_seed(1))
        wiener, ends = Wiener(SensorNoise(1e-3)), camera().camera.defocus(torch.tensor([0.56, 0.54])).tolist()
        errors = []
        for own in (bank, measured(GRID[4:5])):
            model = camera().with_bank(own).psf_model
            restored = restored_over_field(capture, model, wiener, defocus=tuple(ends), tile=64)
            scaled = restored * (image.mean() / restored.mean())
            errors.append(float((scaled - image)[..., :40, :40].square().mean()))
        assert errors[0] < errors[1]

    @torch.no_grad()
    def test_feature_an_explanation_is_of_the_place(self):
        """Its nodes are those of a capture there; beyond the measured places PSFs do not change."""
        (image, depth), bank = scene(64, 72), measured(center=(0.0, 0.0))
        found = []
        for center in ((0.0, 0.0), (200.0, 250.0)):
            optics = camera(field_center=center).with_bank(bank)
            nodes = optics.psf_model.field_of((64, 72), center).nodes
            words = optics.explain(image, depth).scene
            assert (f" at {nodes[0]}x{nodes[1]} places over the picture" in words) == (nodes != (1, 1))
            found.append(nodes)
        assert found[0] != found[1]

    def test_feature_gradients_and_the_transpose(self):
        optics, (image, depth) = camera().with_bank(measured()), scene(64, 72)
        operator, image = LinearCamera(optics, depth), image.double()
        other = torch.rand_like(image)
        left, right = (operator(image) * other).sum(), (image * operator.adjoint(other)).sum()
        assert abs(float(left / right) - 1) < 1e-12

    def test_feature_files(self, tmp_path):
        bank = measured(GRID[:4])
        bank.save(tmp_path / "field.safetensors")
        again = FieldBank.load(tmp_path / "field.safetensors")
        assert all(torch.equal(value, getattr(again, name)) for name, value in vars(bank).items() if value is not None)
        image, depth = scene()
        optics = camera()
        assert torch.equal(optics.with_bank(again)(image, depth), optics.with_bank(bank)(image, depth))
        with pytest.raises(ValueError, match=r"is not a PSF bank: its format is .kornia_tidy\.field_bank"):
            PSFBank.load(tmp_path / "field.safetensors")
        tensors = load_file(tmp_path / "field.safetensors")
        save_file(tensors, tmp_path / "other.safetensors", {"format": "other"})
        with pytest.raises(ValueError, match="is not a PSF bank over the field: its format is 'other'"):
            FieldBank.load(tmp_path / "other.safetensors")
        bad = {**tensors, "light": tensors["light"][1:].contiguous()}
        save_file(bad, tmp_path / "bad.safetensors", {"format": "kornia_tidy.field_bank/1"})
        with pytest.raises(ValueError, match=r"cannot read .*bad.safetensors: light must have shape \(4, "):
            FieldBank.load(tmp_path / "bad.safetensors")

    def test_feature_the_axis_and_settings(self):
        optics = camera().with_bank(measured())
        assert torch.equal(optics.psf_bank().psfs, optics.psf_bank(field=[(0.0, 0.0)]).psfs[0])
        assert optics.psf_bank(field=GRID, defocus=[-3.0, 3.0]).psfs.shape[:2] == (9, 2)
        other = camera().with_bank(measured(center=(400.0, 510.0)))
        assert other.settings()["measured PSFs"] != optics.settings()["measured PSFs"]

    @pytest.mark.parametrize(
        ("banks", "field", "light", "error", "message"),
        [
            (2, [(0, 0)], None, ValueError, "got 2 banks, 1 different places and 1 values of light"),
            (2, [(0, 0), (0, 0)], None, ValueError, "2 banks, 1 different places"),
            (2, [(0, 0), (0, 9)], [1.0], ValueError, "and 1 values of light"),
            (2, [(0, 0), (0, 9)], [1.0, -1.0], ValueError, r"light must be positive, got \[1.0, -1.0\]"),
            (2, [(0, 0), (0, math.nan)], None, ValueError, "field must be finite"),
            (2, "here", None, TypeError, r"field must be points \(y, x\) in sensor pixels"),
        ],
    )
    def test_exception(self, banks, field, light, error, message):
        own = PSFBank.from_measured(torch.rand(2, 1, 5, 5), torch.tensor([-5.0, 5.0]))
        with pytest.raises(error, match=message):
            FieldBank.from_measured([own] * banks, field, light)
        other = PSFBank.from_measured(torch.rand(2, 1, 5, 5), torch.tensor([-5.0, 6.0]))
        with pytest.raises(ValueError, match="same defocus, colours and window"):
            FieldBank.from_measured([own, other], [(0, 0), (0, 9)])
