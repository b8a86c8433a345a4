"""How long a whole capture takes, and a step of training."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.psf import AliasingWarning


@pytest.fixture(params=["paper", "draft", "balanced"])
def optics(request, device):
    with pytest.warns(AliasingWarning) if request.param == "paper" else nullcontext():
        return TiDyOptics(PixelwiseMask(5), fidelity=request.param).to(device)


def facts(optics):
    return {"masks": 5, "layers": len(optics.defocus_nodes), "window": optics.window, "wavelengths": 3, "pupil": 23}


class TestCapture:
    def test_capture(self, bench, optics, scene):
        with torch.no_grad():
            bench(lambda: optics(*scene), **facts(optics))

    def test_capture_and_gradients(self, bench, optics, scene):
        bench(lambda: torch.autograd.grad(optics(*scene).mean(), optics.masks.phase), **facts(optics))
