"""Every public operation, head, loss and data set on a simulated accelerator: values and gradients of the CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction import JointHead, NAFNet, Refocused, Residual, losses, metrics
from kornia_tidy.training.coded_datasets import CodedCaptures, render_scenes
from tests.base import BaseTester
from tests.operations import OPERATIONS, bank_for
from tests.reconstruction import test_closed_form_head, test_head, test_joint_closed_form, test_layered_joint
from tests.simulated_device import DEVICE, SimulatedDevice, moved
from tests.test_kinds import argument, bound

# Sums of 1e4 products in float32 at most, and gradients of theirs; see tests/test_accelerators.py.
ROUNDING, OF_GRADIENTS = 1e-5, 1e-4
EPSILON = {"occlusion": 1e-2}  # in float32 its divisors have a larger one: see tests/test_accelerators.py


def learnt(call: Callable[[Tensor], Any], given: Tensor) -> list[Tensor]:
    """Return all tensors that a call returns, and the gradient of its argument."""
    found = call(given)
    outputs = [found] if isinstance(found, Tensor) else list(found)
    light = sum(x.square().sum() for x in outputs)
    gradients = torch.autograd.grad(light, given) if light.requires_grad else ()
    return [*outputs, *gradients]


def refocused() -> Refocused:
    head = Refocused(NAFNet(3 + 3, 3, width=2), layers=3)
    head.set_psfs(bank_for(torch.rand(1, 3, 4, 4)))
    return head.eval()


def scored(loss: Callable[..., Tensor]) -> Callable[[Tensor], Tensor]:
    target = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(5))
    return lambda x: loss(x, target)


HEADS: dict[str, Callable[[], Callable[[Tensor], Any]]] = {
    **{name: partial(test_head.trained, name) for name in test_head.HEADS},
    "closed form": lambda: test_closed_form_head.head_of(None),
    "closed form and network": lambda: test_closed_form_head.head_of(
        test_closed_form_head.small(layers=4), 4, trained=True
    ),
    "joint": lambda: JointHead(test_joint_closed_form.joint(trained=True)),
    "layers and joint": lambda: JointHead(test_layered_joint.stirred()),
    "residual": lambda: Residual(NAFNet(width=2)).eval(),
    "refocused": refocused,
    **{name: partial(scored, getattr(losses, name)) for name in ("mse_loss", "l1_loss", "rmse_loss", "gradient_loss")},
    "psnr": lambda: scored(metrics.psnr),
    "ssim": lambda: scored(metrics.ssim),
}


class OnDevice(BaseTester):
    def assert_agrees(
        self,
        call: Callable[[Tensor], Any],
        given: Tensor,
        epsilon: float = 0,
        rounded: Tensor | None = None,
    ) -> None:
        """Compare on devices with float64 and without, where an operation may have a larger epsilon.

        The tolerance is the rounding's, or twice what a picture that is rounded otherwise changes.
        """
        expected = learnt(call, given.clone().requires_grad_())
        others = expected if rounded is None else learnt(call, rounded.requires_grad_())
        for float64, least in ((True, 0), (False, epsilon)):
            with SimulatedDevice(float64=float64) as device:
                found = learnt(moved(call, device), device.put(given.clone().requires_grad_()))
            assert len(found) == len(expected)
            for number, (one, other) in enumerate(zip(found, expected, strict=True)):
                assert one.device.type == DEVICE.type
                rounding = OF_GRADIENTS if number == len(expected) - 1 else ROUNDING
                atol = max(rounding, least) * max(1e-30, float(other.detach().abs().max()))
                atol = max(atol, 2 * float((others[number] - other).detach().abs().max()))
                self.assert_close(one.on_cpu.detach(), other.detach(), rtol=0, atol=atol)


class TestOperations(OnDevice):
    @pytest.mark.parametrize("name", OPERATIONS)
    def test_feature_agrees_with_the_cpu(self, name):
        given = argument(OPERATIONS[name])
        self.assert_agrees(bound(OPERATIONS[name], given), given, EPSILON.get(name, 0))


@pytest.mark.takes_seconds
class TestHeadsAndLosses(OnDevice):
    @pytest.mark.parametrize("name", HEADS)
    def test_feature_agrees_with_the_cpu(self, name):
        generator = torch.Generator().manual_seed(0)
        call = HEADS[name]()
        given = torch.rand(2, 3, 16, 16, generator=generator)
        signs = torch.randint(0, 2, given.shape, generator=generator) * 2 - 1
        rounded = given * (1 + torch.finfo(given.dtype).eps * signs)
        self.assert_agrees(call, given, rounded=rounded)


@pytest.mark.parametrize("float64", [True, False], ids=["float64", "no_float64"])
class TestDataSets(BaseTester):
    """Data sets hold their items on the CPU; a camera on an accelerator takes their pictures there."""

    def test_feature_a_transform_moves_items_there_and_back(self, float64):
        transform = partial(self.camera(SensorNoise(0.01)).as_transform, seed=3)
        items = [{**self.scenes()[0], "index": 0}, (torch.full((3, 32, 32), 0.5), torch.ones(1, 32, 32))]
        whole = {**items[0], "image": (items[0]["image"] * 255).to(torch.uint8)}
        for item in (items[0], whole):
            expected = transform()(item)
            with SimulatedDevice(float64=float64) as device:
                found = device.put(self.camera(SensorNoise(0.01))).as_transform(seed=3)(item)
                assert device.uploads
            assert found.keys() == expected.keys()
            for name, value in expected.items():
                if isinstance(value, Tensor):
                    assert found[name].device.type == "cpu"
                    atol = 1 if value.dtype == torch.uint8 else ROUNDING
                    self.assert_close(found[name].double(), value.double(), rtol=0, atol=atol if name == "image" else 0)
        with SimulatedDevice(float64=float64) as device:
            coded, depth = device.put(self.camera()).as_transform()(items[1])
        self.assert_close(coded, self.camera()(*items[1]), rtol=0, atol=ROUNDING)
        assert depth is items[1][1]

    def test_exception_a_picture_and_a_camera_on_two_devices(self, float64):
        image, depth = torch.full((3, 32, 32), 0.5), torch.ones(1, 32, 32)
        with SimulatedDevice(float64=float64) as device:
            there = device.put(self.camera())
            for camera, *sample in (
                (there, image, depth),
                (there, device.put(image), depth),
                (self.camera(), device.put(image), device.put(depth)),
            ):
                with pytest.raises(ValueError, match="image and depth must be on the camera's device"):
                    camera(*sample)

    def test_feature_a_data_set_is_rendered(self, float64, tmp_path):
        render_scenes(self.camera(SensorNoise(0.01)), self.scenes(), tmp_path / "cpu", seed=5)
        with SimulatedDevice(float64=float64) as device:
            render_scenes(device.put(self.camera(SensorNoise(0.01))), self.scenes(), tmp_path / "there", seed=5)
            assert device.launches
        for found, expected in zip(CodedCaptures(tmp_path / "there"), CodedCaptures(tmp_path / "cpu"), strict=True):
            for name in ("image", "depth", "mask"):
                assert torch.equal(found[name], expected[name])
            self.assert_close(found["coded"], expected["coded"], rtol=0, atol=1 / 255 + ROUNDING)  # rounded to 8 bits

    def test_feature_batches_of_a_loader(self, float64):
        batch = next(iter(DataLoader(self.scenes(), batch_size=2)))
        expected = self.camera()(batch)["image"]
        with SimulatedDevice(float64=float64) as device:
            there = {name: device.put(batch[name]) for name in ("image", "depth")}
            found = device.put(self.camera())(there)["image"]
            assert found.device.type == DEVICE.type
        self.assert_close(found.on_cpu, expected, rtol=0, atol=ROUNDING)

    @staticmethod
    def camera(sensor: SensorNoise | None = None) -> TiDyOptics:
        return TiDyOptics(PixelwiseMask(2, generator=torch.Generator().manual_seed(0)), sensor=sensor)

    @staticmethod
    def scenes() -> DeadLeaves:
        return DeadLeaves(2, 32, 32, num_leaves=50)
