from __future__ import annotations

import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.design.tradeoff import Conditions
from kornia_tidy.design.tradeoff.conditions import device_name
from tests.base import BaseTester


class TestConditions(BaseTester):
    def test_smoke_here_and_now(self):
        optics = TiDyOptics(PixelwiseMask(2), fidelity=Fidelity(window=9))
        here = Conditions.here_and_now("a scene", optics, torch.rand(3, 8, 8))
        assert (here.height, here.width, here.channels, here.masks) == (8, 8, 3, 2)
        assert here.torch == torch.__version__
        assert here.date.endswith("+00:00")

    def test_smoke_device_name(self):
        assert device_name(torch.device("cpu")).endswith("CPUs")
