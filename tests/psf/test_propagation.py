"""The matrix transform against analytic optics, lentil and SciPy. All in float64."""

from __future__ import annotations

import math

import lentil
import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import j1

from kornia_tidy.optics import circular_aperture
from kornia_tidy.optics.quadrature import band_limited_quadrature
from kornia_tidy.psf.energies import pixel_energies
from kornia_tidy.psf.propagation import (
    cell_integrals,
    gauss_legendre,
    gauss_legendre_order,
    pixel_frequencies,
    sensor_kernels,
)
from tests.base import BaseTester

DISC_CELLS, DISC_PITCH = 512, 2.02 / 512


def point_intensity(field: torch.Tensor, psi: float, frequency: torch.Tensor, pitch: float) -> torch.Tensor:
    """Intensity at points, not pixels: |K field K^T|^2."""
    highest = float(frequency.abs().max())
    kernel = cell_integrals([psi], frequency, highest, field.shape[-1], pitch)[0]
    return (kernel @ field.to(torch.complex128) @ kernel.mT).abs().square()


class TestGaussLegendre(BaseTester):
    @pytest.mark.parametrize("half_range", [0.0, 0.5, 3.0, 40.0])
    def test_feature_integrates_waves_within_the_tolerance(self, half_range):
        for tolerance in (1e-2, 1e-9):
            nodes, weights = gauss_legendre(gauss_legendre_order(half_range, tolerance))
            b = torch.linspace(0, half_range, 101, dtype=torch.float64)
            mean = (torch.cos(2 * b[:, None] * nodes) * weights).sum(-1)
            assert float((mean - torch.sinc(b / math.pi)).abs().max()) <= 2 * tolerance

    @pytest.mark.parametrize("half_range", [0.0, 0.5, 3.0, 8.0, 40.0])
    def test_feature_spread_nodes_integrate_waves_within_the_tolerance(self, half_range):
        for tolerance in (1e-2, 1e-3, 1e-9):
            nodes, weights = band_limited_quadrature(half_range, tolerance)
            b = np.linspace(0, half_range, 101)
            mean = np.exp(1j * b[:, None] * nodes) @ weights / 2
            assert np.abs(mean - np.sinc(b / math.pi)).max() <= 2 * tolerance
            assert len(nodes) <= gauss_legendre_order(half_range, tolerance)

    def test_feature_fewer_spread_nodes_are_enough(self):
        assert [len(band_limited_quadrature(half, 1e-3)[0]) for half in (3.0, 4.5, 7.0)] == [4, 4, 5]
        assert [gauss_legendre_order(half, 1e-3) for half in (3.0, 4.5, 7.0)] == [4, 5, 7]
        assert len(band_limited_quadrature(0.0, 1e-3, 4)[0]) == 4

    def test_exception_a_phase_must_be_finite(self):
        with pytest.raises(ValueError, match="a phase across an interval must be finite radians, got nan"):
            band_limited_quadrature(math.nan, 1e-3)

    def test_feature_one_point_is_enough_for_a_constant(self):
        assert gauss_legendre_order(0.0, 1e-9) == 1


class TestCellIntegrals(BaseTester):
    @pytest.mark.parametrize("psi", [0.0, 7.0, -60.0, 2000.0])
    def test_feature_equals_adaptive_quadrature(self, psi):
        frequency = torch.tensor([-13.7, 0.0, 4.2], dtype=torch.float64)
        got = cell_integrals([psi], frequency, 13.7, 5, 0.4)[0]
        for i, u in enumerate(frequency.tolist()):
            for n in range(5):
                lo, hi = (n - 2.5) * 0.4, (n - 1.5) * 0.4
                real, imag = (
                    quad(lambda x, u=u, f=f: f(psi * x * x - 2 * math.pi * u * x), lo, hi, limit=2000, epsabs=1e-11)[0]
                    for f in (math.cos, math.sin)
                )
                assert abs(complex(got[i, n]) - complex(real, imag)) < 1e-9

    def test_gradcheck_in_frequency(self):
        frequency = torch.tensor([-3.0, 0.1, 2.0])
        self.gradcheck(lambda u: torch.view_as_real(cell_integrals([5.0, -2.0], u, 3.1, 6, 0.3)), (frequency,))


@pytest.fixture(scope="module")
def disc() -> torch.Tensor:
    return circular_aperture(DISC_CELLS, DISC_PITCH, edges="area")


class TestAgainstAnalyticOptics(BaseTester):
    def test_feature_airy_pattern_and_its_zeros(self, disc):
        v = torch.cat([torch.linspace(0.01, 6, 120), torch.tensor([1.21967, 2.23313, 3.23832])]).double()
        intensity = point_intensity(disc, 0.0, torch.cat([torch.zeros(1).double(), v / 2]), DISC_PITCH)
        slice_x = intensity[0, 1:] / intensity[0, 0]
        airy = torch.from_numpy((2 * j1(np.pi * v.numpy()) / (np.pi * v.numpy())) ** 2)
        assert float((slice_x - airy).abs().max()) < 1e-4
        assert float(slice_x[-3:].max()) < 1e-4
        diagonal = intensity.diagonal()[1:] / intensity[0, 0]
        airy = torch.from_numpy((2 * j1(np.pi * 2**0.5 * v.numpy()) / (np.pi * 2**0.5 * v.numpy())) ** 2)
        assert float((diagonal - airy).abs().max()) < 1e-4

    @pytest.mark.parametrize("psi", [0.0, 3.0, 20.0])
    def test_feature_defocus_otf_of_a_square_pupil(self, psi):
        """Goodman, section 6.4: (1 - s) sinc(4 psi / pi s (1 - s)) on each axis, s the share of the cut-off."""
        u = torch.arange(-500, 501, dtype=torch.float64) * 0.2
        cells = 23
        kernel = cell_integrals([psi], u, 100.0, cells, 2 / cells)[0]
        line = (kernel @ torch.ones(cells, dtype=torch.complex128)).abs().square() * 0.2 / 2
        for s in (0.1, 0.25, 0.5, 0.75, 0.9):
            otf = float((line * torch.cos(2 * math.pi * 2 * s * u)).sum())
            assert abs(otf - (1 - s) * np.sinc(4 * psi / math.pi * s * (1 - s))) < 1e-4


class TestAgainstLentil(BaseTester):
    def test_feature_equals_lentil_on_the_same_grid(self):
        """Lentil samples the pupil at points; the integral over flat cells differs by the cell's sinc, exactly."""
        size, padded, wavelength, diameter, focal = 65, 260, 530e-9, 2.835e-3, 50e-3
        pitch = 2 / (size - 1)  # pupil radii
        x = (np.arange(size) - size // 2) * pitch
        grid_x, grid_y = np.meshgrid(x, x)
        open_ = (np.hypot(grid_x, grid_y) <= 1 + 1e-9) * 1.0
        phase = open_ * (6 * np.hypot(grid_x, grid_y) ** 2 + 1.7 * grid_x**3 + grid_y)
        dx = diameter / (size - 1)
        pupil = lentil.Pupil(amplitude=open_, opd=phase * wavelength / (2 * np.pi), pixelscale=dx, focal_length=focal)
        scale = wavelength * focal / (padded * dx)
        wave = lentil.Wavefront(wavelength) * pupil
        theirs = lentil.propagate_dft(wave, pixelscale=scale, shape=(129, 129), oversample=1).intensity

        u = (torch.arange(129, dtype=torch.float64) - 64) / (padded * pitch)
        field = torch.from_numpy(open_ * np.exp(1j * phase))
        sinc = torch.sinc(u * pitch).square()
        ours = point_intensity(field, 0.0, u, pitch) / (sinc[:, None] * sinc) / pitch**4
        ours, theirs = ours.numpy() / ours.max().item(), theirs / theirs.max()
        assert np.abs(ours - theirs).max() < 1e-12


class TestPixelEnergies(BaseTester):
    @staticmethod
    def psf(phase: torch.Tensor, psi: float, window: int = 31, step: float = 0.39) -> torch.Tensor:
        disc = circular_aperture(phase.shape[-1])
        kernels = sensor_kernels([psi], step, window, phase.shape[-1], 0.1, 1.05, 1e-6)
        field = disc * torch.exp(1j * phase.double())
        light = pixel_energies(
            field.reshape(-1, *field.shape[-2:]), torch.full((phase[..., 0, 0].numel(),), 1.0), kernels
        )
        return light[0] / (disc.sum() * 0.01)

    @pytest.fixture
    def phase(self):
        return torch.rand(23, 23, dtype=torch.float64) * 7.1

    @pytest.mark.parametrize("psi", [0.0, -13.0])
    def test_feature_rotating_the_mask_rotates_the_psf(self, phase, psi):
        rotated = self.psf(torch.rot90(phase), psi)
        assert float((rotated - torch.rot90(self.psf(phase, psi))).abs().max()) < 1e-12

    def test_feature_conjugate_field_mirrors_the_psf(self, phase):
        mirrored = self.psf(-phase, -9.0)
        assert float((mirrored - self.psf(phase, 9.0).flip(0, 1)).abs().max()) < 1e-12

    def test_convention_tilt_along_x_moves_the_psf_to_larger_columns(self):
        x = (torch.arange(23) - 11) * 0.1
        step, shift = 0.39, 4
        tilt = 2 * math.pi * step * shift * x  # radians; the light moves by tilt's slope / 2 pi
        for phase, where in ((tilt.expand(23, 23), (15, 19)), (tilt[:, None].expand(23, 23), (19, 15))):
            psf = self.psf(phase, 0.0, step=step)
            assert divmod(int(psf.argmax()), 31) == where

    def test_feature_pixel_frequencies_are_centred_and_spaced(self):
        u = pixel_frequencies(0.5, 5, 3).reshape(5, 3)
        self.assert_close(u.mean(1), torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0]))
        assert bool((u.diff() > 0).all())
        assert bool((u[:, 2] - u[:, 0] < 0.5).all())
