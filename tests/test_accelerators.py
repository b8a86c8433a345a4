"""The package on a simulated accelerator: the CPU's values and gradients, few launches, and no wait but one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.psf.pupil import pupil_field
from kornia_tidy.render import gather
from tests.base import BaseTester
from tests.benchmarks.launches import step_counts
from tests.simulated_device import DEVICE, SimulatedDevice

COMPOSITINGS = ("gather", "scatter", "occlusion")
# A PSF sums some 1e4 products in float32, and a transform some tens: 1e-5 of the light at most. The gradients of masks
# are differences of such sums over all pixels, ten times smaller than these.
ROUNDING, OF_GRADIENTS = 1e-5, 1e-4


def scene(batch: int = 2, side: int = 40, channels: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(batch, channels, side, side, generator=generator)
    coarse = 0.35 + 3 * torch.rand(batch, 1, 4, 4, generator=generator)
    return image, torch.nn.functional.interpolate(coarse, (side, side), mode="bilinear")


def fidelity_of(name: str, **settings: Any) -> Fidelity:
    fidelity = Fidelity.of(name)
    return fidelity if name == "paper" else replace(fidelity, window=15, **settings)


def train(optics: TiDyOptics, image: torch.Tensor, depth: torch.Tensor) -> list[torch.Tensor]:
    """Return a capture, and the gradients of all parameters and of a depth that is learnt."""
    coded = optics(image, depth)
    parameters = [x for x in (*optics.parameters(), depth) if x.requires_grad]
    return [coded, *(torch.autograd.grad(coded.square().mean(), parameters) if parameters else ())]


def on_cpu(tensor: torch.Tensor) -> torch.Tensor:
    """Return what a simulated tensor holds, and refuse one that fell back to the CPU."""
    assert tensor.device.type == DEVICE.type, f"a tensor of shape {tuple(tensor.shape)} is on {tensor.device}"
    return tensor.on_cpu


class AcceleratorTester(BaseTester):
    def assert_agrees(self, optics: TiDyOptics, image, depth, *, scale: float = 1, **options: Any) -> None:
        """Capture and gradients on the device are those of the CPU, to rounding."""
        expected = [x.detach() for x in train(optics, image, depth)]
        with SimulatedDevice(**options) as device:
            found = [on_cpu(x) for x in train(device.put(optics), device.put(image), device.put(depth))]
        for number, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert one.dtype == other.dtype
            atol = scale * (OF_GRADIENTS if number else ROUNDING) * float(other.abs().max())
            self.assert_close(one, other, rtol=0, atol=atol)


class TestCaptures(AcceleratorTester):
    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    @pytest.mark.parametrize("name", ["draft", "balanced", pytest.param("reference", marks=pytest.mark.slow)])
    def test_feature_fidelities_agree_with_the_cpu(self, name, compositing):
        optics = TiDyOptics(fidelity=fidelity_of(name), compositing=compositing, sensor=None)
        image, depth = scene(1, 24)
        self.assert_agrees(optics, image, depth.clamp(0.5, 0.73))

    @pytest.mark.filterwarnings("ignore:the paper's 23x23 pupil")
    def test_feature_paper_agrees_with_the_cpu(self):
        self.assert_agrees(TiDyOptics(fidelity="paper", sensor=None), *scene())

    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular", "valid"])
    def test_feature_borders_and_stray_light_agree_with_the_cpu(self, border):
        fidelity = fidelity_of("balanced", stray_light="veil")
        self.assert_agrees(TiDyOptics(fidelity=fidelity, border=border, sensor=None), *scene(1))

    @pytest.mark.parametrize("compositing", COMPOSITINGS)
    def test_feature_fixed_layers_give_the_same_capture(self, compositing):
        optics = TiDyOptics(fidelity=fidelity_of("balanced"), compositing=compositing, sensor=None)
        image, depth = scene(1)
        expected = optics(image, depth)
        fixed = optics.with_fixed_layers()
        self.assert_close(fixed(image, depth), expected, rtol=0, atol=ROUNDING)
        self.assert_agrees(fixed, image, depth)
        self.assert_agrees(optics.with_fixed_layers(depth), image, depth)

    def test_gradcheck_depth_on_a_node_between_layers(self):
        optics = TiDyOptics(camera=DefocusRange(-20, 20), fidelity=fidelity_of("balanced"), sensor=None)
        self.assert_agrees(optics, scene(1, 24)[0], torch.full((1, 1, 24, 24), 0.5, requires_grad=True))

    def test_feature_noise_is_drawn_on_the_device(self):
        optics = TiDyOptics(fidelity=fidelity_of("balanced"), sensor=SensorNoise(0.01))
        image, depth = scene()
        noise = optics.draw(image)
        expected = optics(image, depth, params=noise)
        with SimulatedDevice() as device:
            params = {name: device.put(x) for name, x in noise.items()}
            optics = device.put(optics)
            found = optics(device.put(image), device.put(depth), params=params)
            assert optics(device.put(image), device.put(depth)).device == DEVICE
        self.assert_close(on_cpu(found), expected, rtol=0, atol=ROUNDING)


class TestWithoutFloat64(AcceleratorTester):
    """As on Apple's mps: every tensor in double precision is refused by the device."""

    def test_feature_reference_computes_in_float32(self):
        image, depth = scene(1, 24)
        optics = TiDyOptics(fidelity=fidelity_of("reference"), sensor=None)
        self.assert_agrees(optics, image, depth.clamp(0.5, 0.73), float64=False)

    def test_feature_occlusion_agrees_to_its_epsilon(self):
        """A divisor of 1e-3 more, where a layer is seen by a tenth of a PSF or more, is 1e-2 of the light at most."""
        optics = TiDyOptics(fidelity=fidelity_of("balanced"), compositing="occlusion", sensor=None)
        image, depth = scene(1, 24)
        expected = optics(image, depth).detach()
        with SimulatedDevice(float64=False) as device:
            found = device.put(optics)(device.put(image), device.put(depth))
        self.assert_close(on_cpu(found), expected, rtol=0, atol=1e-2)

    def test_feature_steep_masks_keep_their_phase(self):
        """1e4 rad, where a product in float32 would be off by up to 1e-3 rad."""
        phase = (torch.rand(2, 8, 8, dtype=torch.float64) * 2e4 - 1e4).float()
        for dispersion in (1.0, 1.137, 0.87):
            expected = (phase.double() * dispersion).sin()
            with SimulatedDevice(float64=False) as device:
                field = pupil_field(device.put(phase), device.put(torch.ones(8, 8)), dispersion)
            self.assert_close(on_cpu(field).imag.double(), expected, rtol=0, atol=1e-5)

    def test_gradcheck_phase_without_whole_waves(self):
        phase = torch.rand(1, 4, 4) * 100
        gradients = []
        for options in ({}, {"float64": False}):
            with SimulatedDevice(**options) as device:
                own = device.put(phase).requires_grad_()
                field = pupil_field(own, device.put(torch.ones(4, 4)), 1.2)
                gradients.append(on_cpu(torch.autograd.grad(field.imag.sum(), own)[0]))
        self.assert_close(*gradients, rtol=0, atol=1e-5)


class TestChecks(BaseTester):
    """What the one look finds is told as on the CPU."""

    @pytest.mark.parametrize(
        ("image", "depth", "message"),
        [
            (float("nan"), 1.0, "image"),
            (0.5, -1.0, r"depth must be positive metres, got -1\.0"),
            (0.5, float("nan"), "depth must be positive metres, got nan"),
        ],
    )
    def test_exception_bad_scene(self, image, depth, message):
        optics = TiDyOptics(fidelity=fidelity_of("draft"))
        given = torch.full((1, 3, 24, 24), image), torch.full((1, 1, 24, 24), depth)
        with SimulatedDevice() as device, pytest.raises(ValueError, match=message):
            device.put(optics)(*map(device.put, given))

    def test_exception_masks_that_are_not_finite(self):
        optics = TiDyOptics(fidelity=fidelity_of("draft"))
        with torch.no_grad():
            optics.masks.phase[0, 3, 3] = float("inf")
        with SimulatedDevice() as device, pytest.raises(ValueError, match="the phase of the masks must be finite"):
            device.put(optics)(*map(device.put, scene(1, 24)))

    def test_exception_nodes_that_do_not_ascend(self):
        given = *scene(1, 24), torch.tensor([1.0, 0.0]), torch.ones(2, 3, 3, 3) / 9
        with SimulatedDevice() as device, pytest.raises(ValueError, match="nodes must ascend strictly"):
            gather(*map(device.put, given))

    def test_feature_pixels_beyond_the_range_are_counted_and_told_once(self):
        image, depth = scene(1, 24)
        depth[..., :2, :3], depth[..., 2, :3] = 0.2, float("inf")
        with SimulatedDevice() as device:
            optics = device.put(TiDyOptics(fidelity=fidelity_of("draft")))
            with pytest.warns(UserWarning, match="6 of 576 pixels have a defocus between"):
                optics(device.put(image), device.put(depth))
            assert optics.clamped_pixels == 6


class TestCounts:
    """Counts that no change may raise; those of occlusion vary with the scene. The benchmark prints them in full."""

    @pytest.mark.parametrize(
        ("compositing", "fixed", "launches"),
        [
            ("gather", False, 178),
            ("gather", True, 171),
            ("scatter", False, 188),
            ("scatter", True, 181),
            ("occlusion", False, 300),
            ("occlusion", True, 283),
        ],
    )
    def test_feature_a_training_step_launches_no_more_than_before_and_waits_once(self, compositing, fixed, launches):
        first, second = step_counts(compositing, fixed=fixed, batch=1, side=24, window=15)
        assert max(first.launches, second.launches) <= launches
        assert first.waits == second.waits == (0 if fixed else 1)
        assert not fixed or second.uploads == 0

    def test_feature_one_wait_without_gradients_too(self):
        with SimulatedDevice() as device, torch.no_grad():
            optics = device.put(TiDyOptics(fidelity=fidelity_of("balanced")))
            optics(*map(device.put, scene()))
            device.reset()
            optics(*map(device.put, scene()))
            assert device.waits == 1


class TestLearnableApertures(AcceleratorTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    @pytest.mark.parametrize("shape", [(23, 23), (3, 23, 23)])
    def test_feature_one_for_all_masks_or_one_for_each(self, shape, compositing):
        aperture = nn.Parameter(0.3 + 0.5 * torch.rand(shape, generator=torch.Generator().manual_seed(3)))
        options = {"compositing": compositing, "sensor": None, "fidelity": fidelity_of("balanced")}
        self.assert_agrees(TiDyOptics(PixelwiseMask(3), aperture=aperture, **options), *scene())
