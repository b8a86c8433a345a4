"""Every modulator in time: shots add up to the exposure, each moment sees its own scene, what is at once is one moment.

A new modulator belongs into MODULATORS: a test counts them.
"""

from __future__ import annotations

import pytest
import torch
from torch import nn

import kornia_tidy.optics  # noqa: F401 (all modulators are defined)
from kornia_tidy import DwellTimes, Fidelity, LearnableDwellTimes, PixelwiseMask, Switching, TiDyOptics, burst
from kornia_tidy.augmentation.drawn_camera import PhaseJitter
from kornia_tidy.camera.motion import moment_times, moving_capture
from kornia_tidy.modulator import GreyLevels, PixelCrosstalk, StrokeError
from kornia_tidy.modulator.modulator import DiffractionEfficiency, Modulator, SpatialLightModulator, timeline_of
from kornia_tidy.optics import SYSTEMS
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=10.0, stray_light="discard", double=True)
EFFICIENCY = 0.7


class Foreign(nn.Module):
    """A modulator that does not say when it shows what, as a user may write one."""

    def forward(self, phase):
        return phase, phase.new_tensor([0.2, 0.3, 0.5])


SWAPS = {"linear": {"between": "linear", "samples": 2}, "cyclic": {"cyclic": True}, "random": {}}
MODULATORS = {
    "equal": DwellTimes(),
    "dwell": DwellTimes((1, 2, 1)),
    "learnable": LearnableDwellTimes((1, 2, 3)),
    "foreign": Foreign(),
    "diffraction": DiffractionEfficiency(EFFICIENCY),
    **{f"switching {name}": Switching(8e-3, **options) for name, options in SWAPS.items()},
    "switching learnable": Switching(8e-3, dwell=LearnableDwellTimes((3, 1, 1))),
    "panel": SpatialLightModulator(GreyLevels(4), PixelCrosstalk(0.3), DwellTimes((2, 1, 1)), fill_factor=0.9),
    "panel, diffraction": SpatialLightModulator(GreyLevels(4), DiffractionEfficiency(EFFICIENCY), fill_factor=0.9),
    "diffraction, panel": SpatialLightModulator(DiffractionEfficiency(EFFICIENCY), PixelCrosstalk(0.3)),
    "diffraction, dwell": SpatialLightModulator(DiffractionEfficiency(EFFICIENCY), LearnableDwellTimes((1, 1, 2))),
    "switching, diffraction": SpatialLightModulator(
        StrokeError(0.9), Switching(8e-3, between="linear", samples=2), DiffractionEfficiency(EFFICIENCY)
    ),
    "diffraction, switching": SpatialLightModulator(DiffractionEfficiency(EFFICIENCY), Switching(8e-3)),
    "dwell, panel": SpatialLightModulator(DwellTimes((1, 2, 1)), GreyLevels(4), PixelCrosstalk(0.3)),
    "jitter": PhaseJitter(DwellTimes((1, 2, 1)), 0.3, seed=1),
    "foreign, diffraction": SpatialLightModulator(Foreign(), DiffractionEfficiency(EFFICIENCY)),
    "twice": SpatialLightModulator(DiffractionEfficiency(0.8), DwellTimes((1, 2, 1)), DiffractionEfficiency(0.9)),
}
over_modulators = pytest.mark.parametrize("modulator", MODULATORS.values(), ids=MODULATORS)


def camera(modulator, masks=3, **options) -> TiDyOptics:
    options = {"fidelity": SMALL, "color_space": "linear", "sensor": None, **options}
    return TiDyOptics(PixelwiseMask(masks), modulator=modulator, **options)


def scene(size=24):
    return torch.rand(1, 3, size, size + 2, dtype=torch.float64), 0.3 + torch.rand(1, 1, size, size + 2).double()


def in_each_moment(optics, image):
    return image[:, None].repeat(1, len(moment_times(optics)), 1, 1, 1)


def test_feature_every_modulator_is_tried():
    tried = {type(part) for modulator in MODULATORS.values() for part in modulator.modules()}
    known = {kind for kind in Modulator.__subclasses__() if kind.__module__.startswith("kornia_tidy")}
    assert known <= tried


@over_modulators
class TestTimeline(BaseTester):
    def test_feature_it_is_what_the_modulator_shows(self, modulator):
        phase = 6 * torch.rand(3, 7, 7, dtype=torch.float64)
        shown, (states, weights) = timeline_of(modulator, phase), modulator(phase)
        assert torch.equal(shown.states, states)
        self.assert_close(shown.weights, weights, rtol=0, atol=1e-15)
        self.assert_close(shown.durations.sum(), torch.ones((), dtype=torch.float64))

    def test_feature_each_moment_shares_out_its_light(self, modulator):
        phase = 6 * torch.rand(3, 7, 7, dtype=torch.float64)
        shown, total = timeline_of(modulator, phase), 0
        for moment, duration in enumerate(shown.durations):
            states, weights = shown.moment(moment)
            self.assert_close(weights.sum(), torch.ones((), dtype=torch.float64))
            total = total + duration * torch.einsum("s,syx->yx", weights, states.cos())
        expected = torch.einsum("s,syx->yx", shown.weights, shown.states.cos())
        self.assert_close(total, expected, rtol=0, atol=1e-14)

    def test_feature_moments_fill_the_exposure_in_order(self, modulator):
        """No two moments overlap: sorted by their middles, the first begins at 0 and each where the last ended."""
        shown = timeline_of(modulator, torch.zeros(3, 7, 7, dtype=torch.float64))
        times, durations = shown.moment_times(), shown.durations
        order = times.argsort()
        assert order[0] == 0
        if any(getattr(part, "between", None) == "linear" for part in modulator.modules()):
            return  # the moments within a swap stand at Gauss points, whose weights are no durations
        ends = durations[order].cumsum(0)
        self.assert_close(times[order], ends - durations[order] / 2, rtol=0, atol=1e-14)

    def test_feature_states_at_once_have_the_mean_time_of_their_light(self, modulator):
        shown = timeline_of(modulator, torch.zeros(3, 7, 7, dtype=torch.float64))
        mean = (shown.weights * shown.state_times()).sum()
        self.assert_close(mean, (shown.durations * shown.moment_times()).sum(), rtol=0, atol=1e-14)


@over_modulators
class TestBurstOfEveryModulator(BaseTester):
    def between(self, modulator):
        return sum(timeline_of(modulator, torch.zeros(3, 7, 7, dtype=torch.float64)).durations[3:].tolist())

    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    def test_feature_shots_add_up_to_the_exposure(self, modulator, compositing):
        """And moments too: what is between masks is hidden in a burst, so there it is taken out of the exposure."""
        optics, (image, depth) = camera(modulator, compositing=compositing), scene()
        with torch.no_grad():
            total = burst(optics, image, depth).sum(1)
            exposure = optics(image, depth)
            between = 0
            durations = optics.timeline(torch.float64).durations
            for moment in range(3, len(durations)):
                between = between + durations[moment] * optics.through_moment(moment)(image, depth)
            masks = durations[:3].sum()
        self.assert_close(total * masks + between, exposure, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("compositing", ["gather", "occlusion"])
    def test_feature_a_scene_at_rest_is_the_ordinary_capture(self, modulator, compositing):
        optics, (image, depth) = camera(modulator, compositing=compositing), scene()
        with torch.no_grad():
            moving = moving_capture(optics, in_each_moment(optics, image), in_each_moment(optics, depth))
            self.assert_close(moving, optics(image, depth), rtol=0, atol=1e-12)

    def test_feature_each_moment_sees_the_scene_of_its_time(self, modulator):
        """A light that is on at one moment only leaves the picture of that moment, through all that is shown then."""
        optics, (image, depth) = camera(modulator), scene()
        images, depths = in_each_moment(optics, image), in_each_moment(optics, depth)
        durations = optics.timeline(torch.float64).durations
        with torch.no_grad():
            for moment in (0, len(durations) - 1):
                lit = torch.zeros_like(images)
                lit[:, moment] = image
                expected = durations[moment] * optics.through_moment(moment)(image, depth)
                self.assert_close(moving_capture(optics, lit, depths), expected, rtol=0, atol=1e-12)


class TestDiffractionInTime(BaseTester):
    def test_feature_one_mask_is_one_moment(self):
        optics = TiDyOptics.from_preset("ikoma2021")
        assert moment_times(optics).tolist() == [0.5]
        assert optics.timeline(torch.float32).state_times().tolist() == [0.5, 0.5]

    def test_feature_the_first_of_two_shots_holds_undiffracted_light_of_half_the_time(self):
        optics, (image, depth) = camera(DiffractionEfficiency(EFFICIENCY), masks=2), scene()
        flat = camera(None, masks=1)
        flat.masks.phase.data.zero_()
        own = camera(None, masks=1)
        own.masks.phase.data = optics.masks.phase.data[:1]
        with torch.no_grad():
            shot = burst(optics, image, depth)[:, 0]
            expected = EFFICIENCY * own(image, depth) + (1 - EFFICIENCY) * flat(image, depth)
        self.assert_close(shot, 0.5 * expected, rtol=0, atol=1e-12)

    def test_exception_states_at_once_are_no_dwell_times(self):
        switching = Switching(8e-3, dwell=DiffractionEfficiency(0.7))
        with pytest.raises(ValueError, match="dwell must show one state after another, got DiffractionEfficiency"):
            switching(torch.zeros(2, 5, 5))

    def test_exception_two_parts_that_tell_times(self):
        modulator = SpatialLightModulator(DwellTimes((1, 2)), Switching(8e-3))
        with pytest.raises(TypeError, match=r"one part of a modulator may give .* \['DwellTimes', 'Switching'\]"):
            modulator(torch.zeros(2, 5, 5))

    def test_exception_no_such_moment(self):
        with pytest.raises(ValueError, match="moment must be from 0 to 1, got 2"):
            camera(DiffractionEfficiency(0.7), masks=2).through_moment(2)

    def test_gradients_reach_dwell_times_beside_undiffracted_light(self):
        modulator = SpatialLightModulator(LearnableDwellTimes((1, 2)), DiffractionEfficiency(EFFICIENCY))
        optics, (image, depth) = camera(modulator, masks=2), scene()
        burst(optics, image, depth).square().mean().backward()
        assert float(modulator.parts[0].logits.grad.abs().max()) > 0


@pytest.mark.parametrize("name", SYSTEMS)
class TestPresetsInTime(BaseTester):
    @torch.no_grad()
    def test_feature_shots_and_scenes_at_rest_add_up_to_the_exposure(self, name):
        system = TiDyOptics.from_preset(name, sensor=None, border="replicate", check_inputs=False)
        fidelity = system.fidelity.replace(double=True, stray_light="discard", window=9, occlusion_states="each")
        optics, (image, depth) = system.with_fidelity(fidelity), scene(20)
        expected = optics.decode(optics(image, depth))
        self.assert_close(burst(optics, image, depth).sum(1), expected, rtol=0, atol=1e-12)
        moving = moving_capture(optics, in_each_moment(optics, image), in_each_moment(optics, depth))
        self.assert_close(optics.decode(moving), expected, rtol=0, atol=1e-12)
