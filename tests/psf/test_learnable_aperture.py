"""Apertures that are learnt: a parameter of the camera, and the same physics as an aperture that is given."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from kornia_tidy import DefocusRange, DwellTimes, Fidelity, PixelwiseMask, Switching, TiDyOptics, burst, moving_capture
from kornia_tidy.camera import camera_of_state
from kornia_tidy.modulator import DiffractionEfficiency
from kornia_tidy.optics import Lens, circular_aperture
from kornia_tidy.psf import LearnableAperture
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=10.0)
EXACT = Fidelity(window=5, layer_spacing=20.0, double=True)
LENS = Lens.named("single-50mm", 17.6, 0.595)


def apertures(count: int = 3, size: int = 23, dtype: torch.dtype = torch.float32) -> nn.Parameter:
    drawn = torch.rand(count, size, size, generator=torch.Generator().manual_seed(4), dtype=dtype)
    return nn.Parameter(0.2 + 0.6 * drawn)


def camera(aperture, masks=3, **options) -> TiDyOptics:
    torch.manual_seed(1)
    options = {"fidelity": SMALL, "sensor": None, "color_space": "linear", **options}
    return TiDyOptics(PixelwiseMask(masks), aperture=aperture, **options)


def through_a_lens(aperture, fidelity: Fidelity = SMALL, **options) -> TiDyOptics:
    given = {"camera": LENS.camera(8e-6), "lens": LENS, "field_center": (400.0, -480.0)}
    return camera(aperture, fidelity=fidelity.replace(field_tolerance=0.1), **given, **options)


def scene(dtype=torch.float32):
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(1, 3, 24, 26, generator=generator, dtype=dtype)
    return image, 0.3 + torch.rand(1, 1, 24, 26, generator=generator, dtype=dtype)


class TestLearnableAperture(BaseTester):
    def test_smoke(self):
        aperture = LearnableAperture(nn.Parameter(apertures(1)[0]))
        assert aperture().shape == (23, 23)
        assert "23x23" in repr(aperture)
        assert "each of 3 masks" in repr(LearnableAperture(apertures()))

    @pytest.mark.parametrize(
        ("aperture", "error", "words"),
        [
            (torch.ones(23, 23), TypeError, "must be an nn.Parameter of real floating-point numbers, got Tensor"),
            (nn.Parameter(torch.ones(23, 23, dtype=torch.complex64)), TypeError, "got torch.complex64"),
            (nn.Parameter(torch.ones(23, 22)), ValueError, r"must have shape .*got \(23, 22\)"),
            (nn.Parameter(torch.ones(23)), ValueError, r"got \(23,\)"),
            (nn.Parameter(torch.full((23, 23), 1.5)), ValueError, r"amplitudes in \[0, 1\], got 1.5"),
            (nn.Parameter(torch.full((23, 23), torch.nan)), ValueError, r"amplitudes in \[0, 1\], got nan"),
            (
                nn.Parameter(torch.stack([torch.ones(23, 23), torch.zeros(23, 23)])),
                ValueError,
                "let some light through",
            ),
        ],
    )
    def test_exception(self, aperture, error, words):
        with pytest.raises(error, match=words):
            LearnableAperture(aperture)

    def test_exception_parts_that_do_not_fit(self):
        with pytest.raises(ValueError, match="a whole number of cells for each of the 23 mask pixels"):
            camera(nn.Parameter(torch.ones(20, 20)))
        with pytest.raises(ValueError, match=r"shows the 2 masks one by one, such as .*, got 3 states"):
            camera(apertures(2))
        with pytest.raises(ValueError, match=r"shows the 3 masks one by one, such as .*, got"):
            camera(apertures(), modulator=Switching(8e-3))
        for given in (apertures(2), apertures(2).detach()):
            with pytest.raises(ValueError, match=r"shows the 2 masks one by one, such as .*, got 3 states"):
                through_a_lens(given)

    def test_exception_learning_that_closed_it(self):
        optics = camera(apertures())
        with torch.no_grad():
            optics.aperture.amplitude[1] = -1
        with pytest.raises(ValueError, match="aperture must let some light through"):
            optics(*scene())
        with torch.no_grad():
            optics.aperture.amplitude[1] = torch.nan
        with pytest.raises(ValueError, match="and be finite, got amplitudes up to nan"):
            optics(*scene())

    @pytest.mark.parametrize(
        ("made", "compositing"),
        [(camera, "gather"), (camera, "scatter"), (camera, "occlusion"), (through_a_lens, "occlusion")],
    )
    def test_feature_one_for_all_masks_is_the_given_aperture(self, made, compositing):
        one, usual = apertures(1)[0].detach(), DwellTimes()
        shown = (one, usual), (one.expand(3, 23, 23).clone(), usual), (one, DiffractionEfficiency(0.8))
        for learnt, modulator in shown:
            given, found = (made(a, compositing=compositing, modulator=modulator) for a in (one, nn.Parameter(learnt)))
            self.assert_close(found(*scene()), given(*scene()), rtol=0, atol=1e-6)

    def test_feature_behind_a_lens_captures_follow_it(self):
        """Whatever was captured before, with gradients and without, a capture is that of a new camera."""
        optics, generator = through_a_lens(nn.Parameter(apertures(1)[0].detach())), torch.Generator().manual_seed(7)
        for step in range(4):
            with torch.set_grad_enabled(step % 3 == 1):
                found = optics(*scene())
            if found.requires_grad:
                found.sum().backward()
            given = through_a_lens(optics.aperture().detach().clone())
            given.field_center = optics.field_center
            self.assert_close(found.detach(), given(*scene()).detach(), rtol=0, atol=1e-6)
            with torch.no_grad():
                optics.aperture.amplitude.mul_(0.5 + torch.rand(23, 23, generator=generator))
            optics.field_center = (400.0 * (step // 2 % 2), -480.0)

    def test_feature_behind_a_lens_only_what_its_stop_leaves_open_is_learnt(self):
        optics = through_a_lens(nn.Parameter(apertures(1)[0].detach()))
        optics(*scene()).square().sum().backward()
        from_axis = (torch.arange(23) - 11.0).abs()
        nearest = torch.hypot(*torch.meshgrid(*2 * [(from_axis - 0.5).clamp(min=0)], indexing="ij"))
        reached = optics.aperture.amplitude.grad != 0
        assert torch.equal(reached, nearest < 10)  # 10 mask pixels a stop radius

    @pytest.mark.parametrize("learnt", [False, True])
    def test_exception_open_only_where_the_lens_is_shut(self, learnt):
        amplitude = torch.zeros(23, 23)
        amplitude[:, 0] = 1
        with pytest.raises(ValueError, match=r"through the lens's stop and be finite, got an open area of 0\.0"):
            through_a_lens(nn.Parameter(amplitude) if learnt else amplitude)(*scene())

    def test_feature_the_papers_fidelity(self):
        amplitude = 0.5 * circular_aperture(23).float()
        options = {"camera": DefocusRange(-10, 10), "fidelity": "paper", "color_space": "paper"}
        for shape in ((23, 23), (3, 23, 23)):
            learnt = camera(nn.Parameter(amplitude.expand(shape).clone()), **options)
            self.assert_close(learnt.psf_bank().psfs, camera(amplitude, **options).psf_bank().psfs)

    @pytest.mark.parametrize(
        ("made", "learnt", "compositing"),
        [
            *((camera, True, compositing) for compositing in ("gather", "scatter", "occlusion")),
            (through_a_lens, True, "occlusion"),
            (through_a_lens, False, "gather"),
        ],
    )
    @torch.no_grad()
    def test_feature_masks_count_by_the_light_that_passes(self, made, learnt, compositing):
        """The exposure is the mean of captures through each mask with its aperture, weighted by time and light.

        Behind a lens a cell that its stop cuts counts by its open part.
        """
        amplitude, times = apertures(), torch.tensor([0.25, 0.5, 0.25])
        amplitude[1, :12] *= 0.5
        # Each PSF scaled to one would not be their average scaled.
        options = {"compositing": compositing, "fidelity": SMALL.replace(stray_light="discard")}
        optics = made(amplitude if learnt else amplitude.detach(), modulator=DwellTimes((1, 2, 1)), **options)
        stop = 1.0 if made is camera else circular_aperture(23, 0.1, edges="area").double()
        light = (amplitude.double().square() * stop).sum((1, 2)) * times
        light = (light / light.sum()).float()
        self.assert_close(optics.state_weights(torch.float32), light, rtol=1e-4, atol=0)
        captures = []
        for k, height in enumerate(optics.masks.heights()):
            alone = made(amplitude[k].detach(), **options)
            alone.masks = PixelwiseMask(1, initial=height[None])
            captures.append(alone(*scene()))
            self.assert_close(optics.through_state(k)(*scene()), captures[k], rtol=0, atol=2e-6)
        expected, atol = (
            (light[:, None, None, None, None] * torch.stack(captures)).sum(0),
            2e-6 if made is camera else 2e-5,
        )
        self.assert_close(optics(*scene()), expected, rtol=0, atol=atol)
        image, depth = (part[:, None].repeat(1, 3, 1, 1, 1) for part in scene())
        self.assert_close(moving_capture(optics, image, depth), expected, rtol=0, atol=atol)
        self.assert_close(burst(optics, *scene()).sum(1), expected, rtol=0, atol=atol)
        again = camera_of_state(optics.state_dict())
        again.field_center = optics.field_center
        self.assert_close(again(*scene()), optics(*scene()), rtol=0, atol=1e-6)

    def test_gradcheck_of_amplitudes_behind_a_lens(self):
        """Along a direction, against differences of captures."""
        amplitude = apertures(3, dtype=torch.float64)
        optics = through_a_lens(amplitude, fidelity=EXACT)
        generator = torch.Generator().manual_seed(6)
        way, weight = (torch.randn(s, generator=generator).double() for s in (amplitude.shape, (1, 3, 24, 26)))

        def seen() -> torch.Tensor:
            return (optics(*scene(torch.float64)) * weight).sum()

        slope = float((torch.autograd.grad(seen(), optics.aperture.amplitude)[0] * way).sum())
        with torch.no_grad():
            ends = []
            for step in (1e-5, -2e-5):
                optics.aperture.amplitude.add_(step * way)
                ends.append(float(seen()))
        assert abs((ends[0] - ends[1]) / 2e-5 / slope - 1) < 1e-3

    def test_feature_a_given_amplitude_for_each_mask_is_the_learnable_one(self):
        amplitude = apertures()
        self.assert_close(camera(amplitude)(*scene()), camera(amplitude.detach())(*scene()), rtol=0, atol=1e-6)
        given = camera(amplitude.detach())
        assert torch.equal(camera_of_state(given.state_dict())(*scene()), given(*scene()))

    def test_feature_it_is_a_parameter_of_the_camera(self):
        amplitude = apertures()
        optics = camera(amplitude)
        assert dict(optics.named_parameters())["aperture.amplitude"] is amplitude
        assert optics.aperture.amplitude is amplitude
        masks, rest = optics.parameter_groups(1e-8, lr=1e-2)
        assert any(p is amplitude for p in rest["params"])
        assert not any(p is amplitude for p in masks["params"])
        double = copy.deepcopy(optics).to(torch.float64)
        assert double.aperture.amplitude.dtype == torch.float64
        assert double.psf_model.aperture is double.aperture
        assert amplitude.dtype == torch.float32
        optics.aperture = nn.Parameter(amplitude[0].detach())
        optics(*scene()).sum().backward()
        assert optics.aperture.amplitude.grad.abs().max() > 0

    @pytest.mark.parametrize("shape", [(23, 23), (3, 23, 23)])
    def test_feature_states(self, shape):
        optics = camera(nn.Parameter(torch.rand(shape)))
        with torch.no_grad():
            optics.aperture.amplitude[..., 3, 3] = 1.25  # as a step may leave it
        other = camera(nn.Parameter(torch.ones(shape)))
        other.load_state_dict(optics.state_dict())
        made = camera_of_state(optics.state_dict())
        with torch.no_grad():
            for again in (other, made):
                assert torch.equal(again(*scene()), optics(*scene()))
        with pytest.raises(ValueError, match="the state is that of another camera: aperture is a LearnableAperture"):
            camera(None).load_state_dict(optics.state_dict())
        with pytest.raises(ValueError, match="is a LearnableAperture in the state"):
            camera(None).load_state_dict(optics.state_dict(), take_over=True)

    def test_feature_remembered_psfs_follow_it(self):
        optics = camera(apertures())
        with torch.no_grad():
            first = optics(*scene())
            assert torch.equal(optics(*scene()), first)
        optimizer = torch.optim.Adam([optics.aperture.amplitude], lr=0.1)
        optics(*scene()).square().mean().backward()
        optimizer.step()
        with torch.no_grad():
            second = optics(*scene())
            fresh = copy.deepcopy(optics)(*scene())
        assert not torch.allclose(second, first, atol=1e-5)
        assert torch.equal(second, fresh)

    def test_feature_beyond_an_end_gradients_pass_where_descent_leads_back(self):
        aperture = LearnableAperture(nn.Parameter(torch.full((2, 2), 0.5)))
        with torch.no_grad():
            aperture.amplitude.copy_(torch.tensor([[1.5, 1.5], [-0.5, 0.5]]))
        (aperture() * torch.tensor([[1.0, -1.0], [-1.0, 1.0]])).sum().backward()
        assert aperture.amplitude.grad.tolist() == [[1, 0], [-1, 1]]

    @pytest.mark.parametrize("shape", [(6, 6), (2, 6, 6)])
    def test_gradcheck(self, shape):
        masks, (image, depth) = PixelwiseMask(2, 6).double(), scene(torch.float64)
        image, depth = image[..., :6, :6], depth[..., :6, :6]
        optics = TiDyOptics(masks, aperture=nn.Parameter(torch.ones(shape, dtype=torch.float64)), fidelity=EXACT)
        optics.sensor = None
        given = 0.2 + 0.6 * torch.rand(shape, dtype=torch.float64)

        def captured(amplitude):
            state = {"aperture.amplitude": amplitude}
            return torch.func.functional_call(optics, state, (image, depth))

        assert torch.autograd.gradcheck(captured, (given.requires_grad_(),), fast_mode=True)
