"""How long a capture takes; `make bench`."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import TiDyOptics


@pytest.fixture
def scene():
    return torch.rand(1, 3, 256, 256), torch.linspace(0.3, 3.0, 256 * 256).view(1, 1, 256, 256)


@pytest.mark.parametrize("fidelity", ["draft", "balanced"])
class TestCapture:
    def test_psf_bank(self, benchmark, fidelity):
        optics = TiDyOptics(fidelity=fidelity)
        with torch.no_grad():
            benchmark(optics.psf_bank)

    def test_capture(self, benchmark, fidelity, scene):
        optics = TiDyOptics(fidelity=fidelity)
        with torch.no_grad():
            benchmark(optics, *scene)

    def test_capture_and_gradients(self, benchmark, fidelity, scene):
        optics = TiDyOptics(fidelity=fidelity)
        benchmark(lambda: optics(*scene).sum().backward())
