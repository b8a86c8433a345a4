"""A training step on a simulated accelerator: the loss and all gradients of the CPU."""

from __future__ import annotations

import pytest

from tests.base import BaseTester
from tests.simulated_device import DEVICE, SimulatedDevice, moved

pytest.importorskip("lightning.pytorch")

from tests.training.test_module import TidyTraining, batch, made


class TestTrainingStep(BaseTester):
    @pytest.mark.parametrize("task", ["edof", "depth", "joint"])
    def test_feature_loss_and_all_gradients_agree_with_the_cpu(self, task, monkeypatch):
        """Sums of 1e5 products in float32, and gradients of theirs; see tests/test_accelerators.py."""
        monkeypatch.setattr(TidyTraining, "log", lambda *arguments, **options: None)
        module, scene = made(task=task, sigma=0.0), batch()
        with SimulatedDevice() as device:
            there = device.put(module)
            found = there.training_step(moved(scene, device), 0)
            found.backward()
            gradients = {name: x.grad for name, x in there.named_parameters() if x.grad is not None}
        loss = module.training_step(scene, 0)
        loss.backward()
        assert found.device.type == DEVICE.type
        self.assert_close(found.on_cpu.detach(), loss.detach(), rtol=1e-5, atol=0)
        own = {name: x.grad for name, x in module.named_parameters() if x.grad is not None}
        assert own.keys() == gradients.keys()
        for name, gradient in own.items():
            self.assert_close(gradients[name].on_cpu, gradient, rtol=0, atol=1e-4 * float(gradient.abs().max()))
