"""How long a scene takes to render through a PSF bank that is there already: by method, by layers, by window."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.render import assign_layers, render
from kornia_tidy.render.scene import LAYER_MODES


def run(bench, size, device, compositing="gather", layers=21, mode="linear", window=23, gradients=False):
    psfs = torch.rand(layers, 3, window, window, device=device, requires_grad=gradients)
    bank = PSFBank(psfs, torch.linspace(-20, 20, layers, device=device), torch.ones(layers, 3, device=device))
    image = torch.rand(1, 3, size, size, device=device)
    defocus = torch.linspace(-20, 20, size * size, device=device).view(1, 1, size, size)

    def action():
        coded = render(image, defocus, bank, compositing, layers=mode)
        return torch.autograd.grad(coded.mean(), psfs) if gradients else coded

    bench(action, layers=layers, window=window, wavelengths=3)


class TestRendering:
    @pytest.mark.parametrize("layers", [1, 5, 21])
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_by_layers(self, bench, size, device, compositing, layers):
        run(bench, size, device, compositing, layers)

    @pytest.mark.parametrize("mode", LAYER_MODES)
    def test_by_mode(self, bench, size, device, mode):
        run(bench, size, device, mode=mode)

    @pytest.mark.parametrize("window", [9, 61])
    def test_by_window(self, bench, size, device, window):
        run(bench, size, device, window=window)

    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    def test_with_gradients_to_the_psfs(self, bench, size, device, compositing):
        run(bench, size, device, compositing, gradients=True)

    def test_assign_layers(self, bench, size, device):
        defocus = torch.linspace(-20, 20, size * size, device=device).view(1, 1, size, size)
        nodes = torch.linspace(-20, 20, 21, device=device)
        bench(lambda: assign_layers(defocus, nodes, "linear"), layers=21)
