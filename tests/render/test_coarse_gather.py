"""Gather on coarse grids, against gather on the sensor's pixels."""

import math
from dataclasses import replace

import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.optics import REFERENCE_WAVELENGTH, annular_aperture, circular_aperture
from kornia_tidy.psf.geometric_psf import geometric_psfs
from kornia_tidy.psf.pupil import Pupil, pupil_over
from kornia_tidy.psf.wide_blur import GRID_ERROR, window_of
from kornia_tidy.render import gather
from kornia_tidy.render.coarse_gather import _sharpened
from kornia_tidy.render.dispatch import Rendering
from kornia_tidy.render.pieces import Piece, render_piece
from tests.base import BaseTester
from tests.polygons import polygon_aperture

STEP = 1.625e-6
PUPIL = pupil_over((1, 23, 23), None, 1.0)
SHAPES = {
    "disc": circular_aperture(23),
    "ring": annular_aperture(23, 0.1, 0.5),
    "triangle": polygon_aperture(23, 0.1, 3),
}


def defocus_of(radius: float) -> float:
    """Defocus in radians whose disc has a radius in pixels."""
    return radius * math.pi * STEP / REFERENCE_WAVELENGTH


def group_of(
    radii: tuple[float, ...], grid: int, dtype: torch.dtype = torch.float32, span=None, window=0, pupil=PUPIL
) -> Piece:
    """Discs of these radii in pixels, on a grid, for the pixels of a span of radii."""
    nodes = [defocus_of(radius) for radius in radii]
    side = window_of(max(radii), STEP, pupil.extent, grid)
    psfs = geometric_psfs(pupil.transmission, pupil.cell_pitch, nodes, STEP * grid, side).to(dtype)[:, None]
    bank = PSFBank(psfs, torch.tensor(nodes, dtype=dtype), psfs.sum((2, 3)))
    ends = None if span is None else (defocus_of(span[0]), defocus_of(span[1]))
    return Piece(lambda: bank, 1.0, ends, grid, window)


def gather_group(image: torch.Tensor, defocus: torch.Tensor, group: Piece, border: str = "reflect") -> torch.Tensor:
    """What the pixels of a group see."""
    return render_piece(image, defocus, group, Rendering("gather", border))


def light(size: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """A scene as rough as photographs: edges of all sizes, with the deviation for which the errors are given."""
    noise = torch.rand(1, 1, size, size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    f = torch.fft.fftfreq(size).double()
    spectrum = torch.fft.fft2(noise - noise.mean()) / (f[:, None].square() + f.square()).sqrt().clamp(min=1 / size)
    plane = torch.fft.ifft2(spectrum).real
    return (0.5 + 0.19 * plane / plane.std()).to(dtype)


def kernels_of(group: Piece, radius: float, size: int) -> list[torch.Tensor]:
    """The light that pixels collect at the four places within a pixel of a grid of two, by the pixel it comes from."""
    image = torch.zeros(1, 1, size, size, dtype=torch.float64, requires_grad=True)
    seen = gather_group(image, torch.full_like(image, defocus_of(radius)).detach(), group, "circular")
    pixels = [seen[0, 0, size // 2 + y, size // 2 + x] for y in (0, 1) for x in (0, 1)]
    return [torch.autograd.grad(pixel, image, retain_graph=True)[0] for pixel in pixels]


class TestGatherGroup(BaseTester):
    def test_smoke_white_stays_white(self):
        seen = torch.linspace(220.0, 340.0, 60).expand(2, 1, 40, 60)
        white = gather_group(torch.ones(2, 1, 40, 60), seen, group_of((24.0, 30.0, 36.0), 2))
        self.assert_close(white, torch.ones_like(white), rtol=0, atol=2e-6)

    def test_feature_error_of_the_grid_is_within_the_promise(self):
        for radius, grid in ((24.0, 2), (48.0, 4)):
            one, fine, coarse = light(160), group_of((radius,), 1), group_of((radius,), grid)
            psi = torch.full((1, 1, 160, 160), defocus_of(radius))
            found = gather_group(one, psi, coarse, "circular")
            exact = gather(one, psi, fine.bank().defocus, fine.bank().psfs, border="circular")
            assert float((found - exact).square().mean().sqrt()) < 1.3 * GRID_ERROR

    def test_feature_each_pixel_takes_the_group_of_its_defocus(self):
        fine = group_of((8.0, 24.0), 1, span=(-math.inf, 24.0))
        coarse = group_of((24.0, 32.0), 2, span=(24.0, math.inf))
        one = light(96)
        psi = torch.linspace(defocus_of(8.0), defocus_of(32.0), 96).expand(1, 1, 96, 96)
        found = sum(gather_group(one, psi, group, "circular") for group in (fine, coarse))
        exact = [group_of((r0, r1), 1).bank() for r0, r1 in ((8.0, 24.0), (24.0, 32.0))]
        both = [gather(one, psi, bank.defocus, bank.psfs, border="circular") for bank in exact]
        expected = torch.where(psi < defocus_of(24.0), both[0], both[1])
        assert float((found - expected).square().mean().sqrt()) < 1.3 * GRID_ERROR

    def test_cardinality_of_borders_and_odd_sizes(self):
        coarse = group_of((24.0, 30.0), 4, window=71)
        for border in ("reflect", "replicate", "zero", "circular"):
            seen = torch.full((1, 1, 33, 50), 250.0)
            assert gather_group(torch.rand(2, 1, 33, 50), seen, coarse, border).shape == (2, 1, 33, 50)
        seen = torch.full((1, 1, 90, 101), 250.0)
        assert gather_group(torch.rand(2, 1, 90, 101), seen, coarse, "valid").shape == (2, 1, 20, 31)

    @pytest.mark.parametrize("aperture", ["disc", "ring", "triangle"])
    def test_feature_light_is_never_below_the_bound(self, aperture):
        """The worst light is white where the kernel is negative; a point of light is the worst for its energy."""
        radius, pupil = 24.0, Pupil(SHAPES[aperture], 0.1)
        group, size = group_of((radius,), 2, torch.float64, pupil=pupil), 62
        sharpened = _sharpened(group.bank().psfs)
        bound = float((-sharpened).clamp(min=0).sum())
        for kernel in kernels_of(group, radius, size):
            worst = (kernel < 0).double()
            darkest = gather_group(worst, torch.full_like(worst, defocus_of(radius)), group, "circular").min()
            assert -bound <= float(darkest) <= 0.9 * float(kernel.clamp(max=0).sum()) < -1e-3
            assert -float(kernel.min()) < 1 / (3 * pupil.light * radius**2)
        assert bound < {"disc": 0.023, "ring": 0.046, "triangle": 0.048}[aperture]

    def test_feature_neighbouring_groups_differ_by_no_more_than_the_bound(self):
        """Half of the absolute difference of their kernels is in one light of 0 and 1 the difference of a pixel."""
        radius, size = 24.0, 62
        groups = [group_of((radius,), grid, torch.float64) for grid in (1, 2)]
        for fine, coarse in zip(*(kernels_of(group, radius, size) for group in groups), strict=True):
            assert 0.01 < float((fine - coarse).abs().sum()) / 2 < 0.034
        one, psi = light(160, torch.float64), torch.full((1, 1, 160, 160), defocus_of(radius), dtype=torch.float64)
        fine, coarse = (gather_group(one, psi, group, "circular") for group in groups)
        reach = float(one.max() - one.min())
        assert float((fine - coarse).abs().max()) < 0.034 * reach
        assert float((fine - coarse).square().mean().sqrt()) < 1.3 * GRID_ERROR

    @pytest.mark.takes_seconds
    def test_gradcheck_of_image_defocus_and_psfs(self):
        fine = group_of((1.0, 3.0), 1, torch.float64, (0.0, 3.0))
        coarse = group_of((3.0, 5.0), 2, torch.float64, (3.0, 9.0))
        psi = torch.tensor([defocus_of(radius) for radius in (1.3, 2.1, 3.4, 4.2, 4.6)], dtype=torch.float64)
        seen = psi.expand(1, 1, 4, 5).clone()

        def render(image, defocus, psfs):
            bank = replace(coarse.bank(), psfs=psfs)
            group = replace(coarse, bank=lambda: bank)
            return gather_group(image, defocus, fine) + gather_group(image, defocus, group)

        inputs = (torch.rand(1, 1, 4, 5, dtype=torch.float64), seen, coarse.bank().psfs.clone())
        for x in inputs:
            x.requires_grad_()
        torch.autograd.gradcheck(render, inputs)
