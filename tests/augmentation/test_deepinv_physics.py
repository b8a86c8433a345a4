"""The camera in deepinv, which imports torchvision: skipped where either is not installed."""

from __future__ import annotations

import pytest
import torch

from tests.augmentation.optional import need, need_torchvision

need_torchvision()
need("deepinv")

import deepinv  # noqa: E402

from kornia_tidy.augmentation.deepinv_physics import CameraPhysics  # noqa: E402
from tests.base import BaseTester  # noqa: E402
from tests.camera.pipeline_samples import camera, scene  # noqa: E402


def physics(compositing: str = "gather", sigma: float = 0.005) -> CameraPhysics:
    optics = camera(compositing=compositing).requires_grad_(False)
    return CameraPhysics(optics, scene(1)[1], noise_model=deepinv.physics.GaussianNoise(sigma))


def smooth_image() -> torch.Tensor:
    image = torch.zeros(1, 3, 40, 48)
    image[..., 8:30, 10:22] = 0.8
    image[:, 1, 20:36, 18:40] = 0.5
    return image


class TestCameraPhysics(BaseTester):
    @pytest.mark.parametrize("border", ["reflect", "valid"])
    @pytest.mark.parametrize("count", [0, 1, 3])
    def test_cardinality(self, count, border):
        optics, (image, depth) = camera(border=border), scene(count)
        for one in (depth, depth[:1]):
            operator = CameraPhysics(optics, one)
            y = operator.A(image)
            assert y.shape == optics(image, depth).shape
            assert operator.A_adjoint(y).shape == image.shape

    def test_exception(self):
        image, depth = scene(2)
        with pytest.raises(ValueError, match="a linear camera needs compositing 'gather' or 'scatter'"):
            CameraPhysics(camera(compositing="occlusion"), depth)
        with pytest.raises(TypeError, match="optics must be a camera"):
            CameraPhysics(torch.nn.Identity(), depth)
        with pytest.raises(ValueError, match="depth must be positive metres, got 0"):
            CameraPhysics(camera(), torch.zeros_like(depth))
        with pytest.raises(ValueError, match=r"light must have 40 x 48 pixels and the batch of the depth"):
            CameraPhysics(camera(), depth)(image[..., :-1])

    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_adjointness_by_deepinv(self, compositing):
        error = physics(compositing).adjointness_test(torch.rand(1, 3, 40, 48))
        assert abs(float(error)) < 1e-2

    @pytest.mark.parametrize("prior", ["total variation", "plug and play"])
    def test_feature_its_solvers_restore_a_capture(self, prior):
        camera_physics, image = physics(), smooth_image()
        torch.manual_seed(1)
        y = camera_physics(image)
        if prior == "total variation":
            regulariser, weight = deepinv.optim.prior.TVPrior(n_it_max=20), {"lambda": 0.01}
        else:
            denoiser = deepinv.models.MedianFilter(3)
            regulariser, weight = deepinv.optim.prior.PnP(denoiser=denoiser), {"g_param": 0.02}
        model = deepinv.optim.optim_builder(
            iteration="PGD",
            prior=regulariser,
            data_fidelity=deepinv.optim.data_fidelity.L2(),
            max_iter=30,
            params_algo={"stepsize": 1.0, **weight},
        )
        with torch.no_grad():
            restored = model(y, camera_physics)
        before, after = ((x - image).square().mean() for x in (y, restored))
        assert after < 0.7 * before
