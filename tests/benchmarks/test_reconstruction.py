"""How long the heads take, at their published widths: to predict, and to learn from one picture."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction import AttentionUNet, MiDaSSmall, PhaseCam3DUNet


@pytest.fixture(params=[AttentionUNet, MiDaSSmall, PhaseCam3DUNet], ids=["attention", "midas", "phasecam3d"])
def head(request, device):
    return request.param().to(device)


@pytest.fixture
def image(size, device):
    return torch.rand(2, 3, size, size, device=device)  # two: normalisation needs more than one value at 1/32


class TestReconstruction:
    def test_predict(self, bench, head, image):
        head.eval()
        with torch.inference_mode():
            bench(lambda: head(image))

    def test_predict_and_gradients(self, bench, head, image):
        learnt = [p for p in head.parameters() if p.requires_grad]
        bench(lambda: torch.autograd.grad(head(image).square().mean(), learnt))
