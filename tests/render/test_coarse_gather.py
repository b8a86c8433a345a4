"""Gather on coarse grids, against gather on the sensor's pixels."""

import math
from types import SimpleNamespace

import pytest
import torch

from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.geometric_psf import geometric_psfs
from kornia_tidy.psf.pupil import pupil_over
from kornia_tidy.psf.wide_blur import GRID_ERROR, SCENE_DEVIATION, window_of
from kornia_tidy.render.coarse_gather import gather_groups
from kornia_tidy.render.compositing import gather
from tests.base import BaseTester

STEP = 1.625e-6
PUPIL = pupil_over((1, 23, 23), None, 1.0)


def group_of(radii: tuple[float, ...], grid: int, dtype: torch.dtype = torch.float32) -> SimpleNamespace:
    """Discs of these radii in pixels, on a grid."""
    nodes = [radius * math.pi * STEP / REFERENCE_WAVELENGTH for radius in radii]
    window = window_of(max(radii), STEP, PUPIL.extent, grid)
    psfs = geometric_psfs(PUPIL.transmission, PUPIL.cell_pitch, nodes, STEP * grid, window).to(dtype)[:, None]
    bank = SimpleNamespace(psfs=psfs, defocus=torch.tensor(nodes, dtype=dtype), veil=None)
    return SimpleNamespace(grid=grid, span=(nodes[0], nodes[-1]), bank=bank)


def light(size: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """A scene as rough as photographs: edges of all sizes, with SCENE_DEVIATION."""
    noise = torch.rand(1, 1, size, size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    f = torch.fft.fftfreq(size).double()
    spectrum = torch.fft.fft2(noise - noise.mean()) / (f[:, None].square() + f.square()).sqrt().clamp(min=1 / size)
    plane = torch.fft.ifft2(spectrum).real
    return (0.5 + SCENE_DEVIATION * plane / plane.std()).to(dtype)


class TestGatherGroups(BaseTester):
    def test_smoke_white_stays_white(self):
        seen = torch.linspace(220.0, 340.0, 60).expand(2, 1, 40, 60)
        white = gather_groups(torch.ones(2, 1, 40, 60), seen, [group_of((24.0, 30.0, 36.0), 2)], 85)
        self.assert_close(white, torch.ones_like(white), rtol=0, atol=2e-6)

    def test_feature_error_of_the_grid_is_within_the_promise(self):
        for radius, grid in ((24.0, 2), (48.0, 4)):
            one, fine, coarse = light(160), group_of((radius,), 1), group_of((radius,), grid)
            psi = torch.full((1, 1, 160, 160), fine.span[0])
            found = gather_groups(one, psi, [coarse], 131, "circular")
            exact = gather(one, psi, fine.bank.defocus, fine.bank.psfs, border="circular")
            assert float((found - exact).square().mean().sqrt()) < 1.3 * GRID_ERROR

    def test_feature_each_pixel_takes_the_group_of_its_defocus(self):
        fine, coarse = group_of((8.0, 24.0), 1), group_of((24.0, 32.0), 2)
        one = light(96)
        psi = torch.linspace(fine.span[0], coarse.span[1], 96).expand(1, 1, 96, 96)
        found = gather_groups(one, psi, [fine, coarse], 75, "circular")
        exact = [group_of((r0, r1), 1).bank for r0, r1 in ((8.0, 24.0), (24.0, 32.0))]
        both = [gather(one, psi, bank.defocus, bank.psfs, border="circular") for bank in exact]
        expected = torch.where(psi < coarse.span[0], both[0], both[1])
        assert float((found - expected).square().mean().sqrt()) < 1.3 * GRID_ERROR

    def test_cardinality_of_borders_and_odd_sizes(self):
        coarse = group_of((24.0, 30.0), 4)
        for border in ("reflect", "replicate", "zero", "circular"):
            seen = torch.full((1, 1, 33, 50), 250.0)
            assert gather_groups(torch.rand(2, 1, 33, 50), seen, [coarse], 71, border).shape == (2, 1, 33, 50)
        seen = torch.full((1, 1, 90, 101), 250.0)
        assert gather_groups(torch.rand(2, 1, 90, 101), seen, [coarse], 71, "valid").shape == (2, 1, 20, 31)

    def test_feature_few_layers_at_a_time_change_nothing(self, monkeypatch):
        group, one = group_of((24.0, 26.0, 28.0, 31.0, 34.0), 2), light(64)
        psi = torch.linspace(group.span[0], group.span[1], 64).expand(1, 1, 64, 64)
        whole = gather_groups(one, psi, [group], 79)
        monkeypatch.setattr("kornia_tidy.render.coarse_gather._LAYER_BYTES", 1)
        self.assert_close(gather_groups(one, psi, [group], 79), whole, rtol=0, atol=1e-6)

    @pytest.mark.takes_seconds
    def test_gradcheck_of_image_defocus_and_psfs(self):
        fine, coarse = group_of((1.0, 3.0), 1, torch.float64), group_of((3.0, 5.0), 2, torch.float64)
        psi = torch.tensor([1.3, 2.1, 3.4, 4.2, 4.6], dtype=torch.float64) * math.pi * STEP / REFERENCE_WAVELENGTH
        seen = psi.expand(1, 1, 4, 5).clone()

        def render(image, defocus, psfs):
            bank = SimpleNamespace(psfs=psfs, defocus=coarse.bank.defocus, veil=None)
            group = SimpleNamespace(grid=2, span=coarse.span, bank=bank)
            return gather_groups(image, defocus, [fine, group], 21)

        inputs = (torch.rand(1, 1, 4, 5, dtype=torch.float64), seen, coarse.bank.psfs.clone())
        for x in inputs:
            x.requires_grad_()
        torch.autograd.gradcheck(render, inputs)
