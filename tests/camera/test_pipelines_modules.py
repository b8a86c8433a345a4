from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor

from kornia_tidy import DefocusRange, PixelwiseMask, ThinLensCamera, TiDyOptics
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


class TestCopies(BaseTester):
    def test_feature_a_pickle_holds_the_camera_and_nothing_of_the_last_scene(self):
        optics = camera()
        fresh = len(pickle.dumps(optics))
        image, depth = scene(1, height=512, width=512)  # 4 MB
        optics(image.requires_grad_(), depth.requires_grad_()).sum().backward()
        optics.zero_grad(set_to_none=True)
        assert len(pickle.dumps(optics)) < fresh + 8_000  # the aperture, 23x23 float64, is made on the first call


def units_in_last_place(a: Tensor, b: Tensor) -> int:
    """Largest distance between positive numbers of half precision, counted in representable numbers."""
    return int((a.view(torch.int16).int() - b.view(torch.int16).int()).abs().max())


@pytest.mark.parametrize("low", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
class TestHalfPrecision(BaseTester):
    def test_feature_equals_float32_on_the_same_rounded_numbers(self, low):
        lens = ThinLensCamera(focus_distance=torch.tensor(0.61), depth_range=(0.25, torch.inf))
        optics = camera(camera=lens).to(low)
        assert {p.dtype for p in optics.parameters()} == {low}
        image, depth = (x.clamp(max=9).to(low) for x in scene())  # the rounded focus moves infinity out of the range
        params = optics.draw(image)
        coded = optics(image, depth, params=params)
        assert coded.dtype == low
        expected = copy.deepcopy(optics).float()(image.float(), depth.float(), params=params)
        assert units_in_last_place(coded, expected.to(low)) <= 1

    def test_feature_gradients_reach_the_masks_in_their_type(self, low):
        optics, (image, depth) = camera().to(low), scene()
        optics(image.to(low), depth.to(low)).float().square().mean().backward()
        assert optics.masks.phase.grad.dtype == low
        assert optics.masks.phase.grad.isfinite().all()

    def test_feature_normalised_disparity_in_half_precision(self, low):
        disparity = torch.linspace(0, 1, 101).to(low)
        range_ = DefocusRange(-20, 20)
        assert torch.equal(range_.defocus(disparity), range_.defocus(disparity.float()).to(low))


class TestPrecision(BaseTester):
    def test_feature_a_float64_image_is_computed_in_float64(self):
        optics, (image, depth) = camera().double(), scene()
        params = optics.draw(image.double())
        exact = optics(image.double(), depth.double(), params=params)
        assert exact.dtype == params["read"].dtype == torch.float64
        single = copy.deepcopy(optics).float()(image, depth, params={k: v.float() for k, v in params.items()})
        error = (exact - single).abs().max()
        assert 0 < error < 1e-5

    @pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16, torch.float32, torch.float64], ids=str)
    def test_feature_autocast_changes_nothing(self, kind):
        optics, (image, depth) = camera(), scene()
        params, image = optics.draw(image), image.to(kind)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            coded = optics(image, depth, params=params)
        assert coded.dtype == kind
        assert torch.equal(coded, optics(image, depth, params=params))


# Inductor imports what torch has deprecated, and leaves complex numbers to eager kernels.
@pytest.mark.filterwarnings("ignore:Torchinductor does not support code generation for complex:UserWarning")
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
class TestCompile(BaseTester):
    @pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
    def test_dynamo_equals_eager_with_the_noise_replayed(self, backend):
        optics, (image, depth) = camera(), scene()
        params = optics.draw(image)
        compiled = torch.compile(optics, fullgraph=True, backend=backend)
        coded = compiled(image, depth, params=params)
        self.assert_close(coded, optics(image, depth, params=params), rtol=1e-5, atol=1e-6)
        (gradient,) = torch.autograd.grad(coded.square().mean(), optics.masks.phase)
        (expected,) = torch.autograd.grad(optics(image, depth, params=params).square().mean(), optics.masks.phase)
        self.assert_close(gradient, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


class TestParts(BaseTester):
    def test_feature_a_new_camera_is_measured_anew(self):
        optics = TiDyOptics(masks=PixelwiseMask(1, initial="flat"))
        fine = optics.window
        optics.camera = ThinLensCamera(pixel_pitch=16e-6)
        # Pixels twice as large: a spot takes half as many, to the next odd number on either side.
        assert abs(optics.window - fine / 2) <= 2
        optics.camera = ThinLensCamera(depth_range=(0.58, 0.61))
        assert optics.window < fine
        assert optics.defocus_nodes[0] == pytest.approx(
            11.911 * (1 / 0.61 - 1 / 0.595), rel=1e-3
        )  # pi R^2 / 530 nm = 11.911 m


class TestOptimiser(BaseTester):
    def test_feature_one_adam_step_moves_heights_by_the_learning_rate_in_metres(self):
        optics = camera(camera=ThinLensCamera(focus_distance=torch.tensor(0.6)), sensor=None)
        optimiser = torch.optim.Adam(optics.parameter_groups(lr_metres=1e-8, lr=1e-3))
        before = optics.masks.heights().detach(), optics.camera.focus_distance.item()
        image, depth = scene()
        (optics(image, depth) - image).square().mean().backward()
        optimiser.step()
        moved = (optics.masks.heights().detach() - before[0]).abs()[:, 5:18, 5:18]  # inside the aperture
        assert ((moved > 0.98e-8) & (moved < 1.02e-8)).all()
        assert abs(optics.camera.focus_distance.item() - before[1]) == pytest.approx(1e-3, rel=1e-2)

    def test_feature_groups_hold_every_parameter_once(self):
        optics = camera(camera=ThinLensCamera(focus_distance=torch.tensor(0.6)))
        grouped = [p for group in optics.parameter_groups(1e-8) for p in group["params"]]
        assert sorted(map(id, grouped)) == sorted(map(id, optics.parameters()))

    @pytest.mark.parametrize("rate", [0.0, -1e-8, float("inf")])
    def test_exception_a_learning_rate_is_positive(self, rate):
        with pytest.raises(ValueError, match="lr_metres must be positive and finite metres"):
            camera().parameter_groups(rate)
