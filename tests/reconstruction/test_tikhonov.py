"""Inversion against dense linear algebra, Wiener's error, and captures made by the renderer."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.reconstruction import Tikhonov, TikhonovLayers
from kornia_tidy.reconstruction.tikhonov import BORDERS, tikhonov, tikhonov_layers, transfer_function
from tests.base import BaseTester
from tests.reconstruction.banks import flat_capture, make_bank, make_psfs

borders = pytest.mark.parametrize("border", BORDERS)


def matrix(psf: np.ndarray, height: int, width: int) -> np.ndarray:
    """Circular convolution with a (P, P) PSF as a matrix, one entry after the other."""
    radius, out = len(psf) // 2, np.zeros((height, width, height, width))
    for y in range(height):
        for x in range(width):
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    out[(y + dy) % height, (x + dx) % width, y, x] += psf[dy + radius, dx + radius]
    return out.reshape(height * width, height * width)


class TestTransferFunction(BaseTester):
    @pytest.mark.parametrize(("rows", "columns", "size"), [(12, 15, 5), (9, 8, 9), (4, 3, 7), (1, 1, 3), (1, 6, 1)])
    def test_feature_equals_numpys_fft_of_the_wrapped_psf(self, rows, columns, size, device, dtype):
        if dtype.itemsize == 2:
            pytest.skip("banks are float32 or better")
        psfs = torch.rand(2, 3, size, size, device=device, dtype=dtype)
        plane = np.zeros((2, 3, rows, columns))
        for y in range(size):
            for x in range(size):
                at = (..., (y - size // 2) % rows, (x - size // 2) % columns)
                plane[at] += psfs[..., y, x].double().cpu().numpy()
        out = transfer_function(psfs, (rows, columns))
        assert out.dtype == (torch.complex128 if dtype == torch.float64 else torch.complex64)
        torch.testing.assert_close(
            out.cpu().to(torch.complex128), torch.from_numpy(np.fft.rfft2(plane)), atol=1e-5, rtol=0
        )

    def test_feature_large_planes_keep_their_phase(self, device):
        """A point beside the chief ray, at all frequencies of a plane 4 million pixels wide, in float32."""
        psf = torch.zeros(3, 3, device=device)
        psf[1, 2] = 1
        out = transfer_function(psf, (1, 4_000_001))[0, -3:].cpu().to(torch.complex128)
        v = torch.arange(1_999_998, 2_000_001, dtype=torch.float64)
        expected = torch.polar(torch.ones(3, dtype=torch.float64), -2 * torch.pi * v / 4_000_001)
        torch.testing.assert_close(out, expected, atol=1e-6, rtol=0)


class TestClosedForms(BaseTester):
    """Both inverses are the solutions of their normal equations, solved densely."""

    @pytest.mark.parametrize("shape", [(6, 7), (5, 4), (3, 8)])
    @pytest.mark.parametrize("weight", [1e-3, 0.5])
    def test_feature_tikhonov_equals_a_dense_solve(self, shape, weight, device):
        psf = make_psfs(1, 1, device=device)[0]
        capture, prior = torch.rand(2, 1, 1, *shape, device=device, dtype=torch.float64)
        a = matrix(psf[0].cpu().numpy(), *shape)
        y, x0 = capture.flatten().cpu().numpy(), prior.flatten().cpu().numpy()
        for start, given in ((0 * x0, None), (x0, prior), (y, capture)):
            expected = np.linalg.solve(a.T @ a + weight * np.eye(len(y)), a.T @ y + weight * start)
            out = tikhonov(capture, psf, weight, prior=given, border="circular")
            self.assert_close(out.flatten().cpu(), torch.from_numpy(expected), atol=1e-11, rtol=0)

    @pytest.mark.parametrize("layers", [1, 2, 5])
    @pytest.mark.parametrize("weight", [1e-3, 1.0])
    def test_feature_layers_equal_a_dense_solve(self, layers, weight, device):
        height, width, channels = 5, 6, 2
        psfs = make_psfs(layers, channels, 3, device=device)
        capture = torch.rand(2, channels, height, width, device=device, dtype=torch.float64)
        out = tikhonov_layers(capture, psfs, weight, border="circular")
        assert out.shape == (2, layers, channels, height, width)
        for channel in range(channels):
            a = np.hstack([matrix(psf[channel].cpu().numpy(), height, width) for psf in psfs])
            for image in range(2):
                y = capture[image, channel].flatten().cpu().numpy()
                expected = np.linalg.solve(a.T @ a + weight * np.eye(a.shape[1]), a.T @ y)
                self.assert_close(
                    out[image, :, channel].flatten().cpu(), torch.from_numpy(expected), atol=1e-10, rtol=0
                )

    def test_feature_smooth_borders_solve_on_the_extended_plane(self, device):
        """The same solve where the plane is the capture led smoothly into its repetition, and the capture's part."""
        psf = make_psfs(1, 1, 3, device=device)[0]
        capture = torch.rand(1, 1, 5, 6, device=device, dtype=torch.float64)
        w = np.array([0.5 - 0.5**1.5, 0.5, 0.5 + 0.5**1.5])  # three more rows and columns, as the PSF has: (8, 9)
        image = capture[0, 0].cpu().numpy()
        image = np.vstack([image, image[[3, 2, 1]]])  # mirrored below is the same as mirrored above here
        image = np.hstack([image, (1 - w) * image[:, [4, 3, 2]] + w * image[:, [3, 2, 1]]])
        a = matrix(psf[0].cpu().numpy(), 8, 9)
        expected = np.linalg.solve(a.T @ a + 0.1 * np.eye(72), a.T @ image.flatten()).reshape(8, 9)[:5, :6]
        self.assert_close(tikhonov(capture, psf, 0.1)[0, 0].cpu(), torch.from_numpy(expected), atol=1e-11, rtol=0)


class TestInverses(BaseTester):
    @borders
    def test_feature_a_point_psf_gives_the_capture(self, border, device, dtype):
        capture = torch.rand(2, 3, 7, 10, device=device, dtype=dtype)
        point = torch.zeros(3, 5, 5, device=device)
        point[:, 2, 2] = 1
        self.assert_close(tikhonov(capture, point, 1e-7, border=border), capture)
        self.assert_close(tikhonov(capture, point, 10.0, prior=capture, border=border), capture)
        self.assert_close(tikhonov_layers(capture, point.expand(4, 3, 5, 5), 1e-7, border=border).sum(1), capture)

    def test_convention_undoes_a_convolution_and_correlate_a_correlation(self, device, dtype):
        """A PSF with light up and to the right only: taken the wrong way round the error is as large as the blur."""
        psf = torch.zeros(1, 5, 5, device=device)
        psf[0, 2, 2], psf[0, 1, 4], psf[0, 0, 2] = 0.55, 0.25, 0.2
        bank = PSFBank.from_measured(psf[None], torch.zeros(1, device=device))
        image = torch.rand(1, 1, 16, 18, device=device, dtype=dtype)
        for correlate in (False, True):
            capture = flat_capture(image, psf, correlate=correlate)
            blur = (capture - image).square().mean()
            for option in (False, True):
                out = Tikhonov(1e-6, "circular", correlate=option)(capture, bank)
                error = (out - image).square().mean()
                assert error < 1e-3 * blur if option is correlate else error > blur
                layer = TikhonovLayers(1e-6, "circular", correlate=option)(capture, bank)[:, 0]
                self.assert_close(layer, out, atol=1e-3 if dtype.itemsize > 2 else 2e-2, rtol=0)

    def test_feature_a_veil_is_taken_off(self, device):
        image = torch.rand(1, 2, 12, 14, device=device, dtype=torch.float64)
        psfs, veil = 0.7 * make_psfs(1, 2, device=device), torch.full((1, 2), 0.3, device=device, dtype=torch.float64)
        bank = PSFBank(psfs, torch.zeros(1, device=device), 1 - veil, veil)
        capture = flat_capture(image, psfs[0], veil=veil)
        self.assert_close(Tikhonov(1e-9, "circular")(capture, bank), image, atol=1e-6, rtol=0)
        self.assert_close(TikhonovLayers(1e-9, "circular")(capture, bank)[:, 0], image, atol=1e-6, rtol=0)
        twice = [torch.cat([value, value]) for value in (psfs, bank.defocus, bank.energy, veil)]
        self.assert_close(Tikhonov(1e-9, "circular")(capture, PSFBank(*twice)), image, atol=1e-6, rtol=0)

    @borders
    @pytest.mark.parametrize("weight", [1e-4, 1.0, 1e4])
    def test_feature_white_stays_white_near_the_capture(self, border, weight, device):
        white = torch.ones(1, 2, 9, 12, device=device, dtype=torch.float64)
        self.assert_close(Tikhonov(weight, border)(white, make_bank(device=device)), white, atol=1e-12, rtol=0)

    def test_feature_the_inverse_is_that_of_the_mean_psf(self, device):
        bank = make_bank(device=device)
        capture = torch.rand(1, 2, 9, 12, device=device, dtype=torch.float64)
        mean = (bank.psfs[0] + bank.psfs[1] + bank.psfs[2]) / 3
        self.assert_close(Tikhonov(0.2)(capture, bank), tikhonov(capture, mean, 0.2, prior=capture), atol=1e-7, rtol=0)


class TestAdjoint(BaseTester):
    @borders
    @pytest.mark.parametrize("shape", [(5, 6), (4, 7)])
    def test_gradcheck(self, border, shape, device):
        capture, psfs = torch.rand(1, 2, *shape, device=device), make_psfs(2, 2, 3, device=device)
        weight, veil = torch.tensor(0.3, device=device), torch.rand(2, 2, device=device)
        self.gradcheck(
            lambda y, h, w, v: tikhonov(y, h[0], w, prior=y, veil=v[0], border=border), (capture, psfs, weight, veil)
        )
        self.gradcheck(
            lambda y, h, w, v: tikhonov_layers(y, h, w, veil=v, border=border), (capture, psfs, weight, veil)
        )


class TestBorders(BaseTester):
    def test_feature_the_border_does_not_ring(self, device):
        """A scene that goes on beyond the capture, which a disc blurs: errors within a PSF of the border, rms."""
        y, x = torch.meshgrid(*[torch.arange(160.0, device=device)] * 2, indexing="ij")
        scene = (0.3 + 0.002 * x + 0.1 * torch.sin(0.31 * x + 0.11 * y) * torch.cos(0.05 * y)).expand(1, 1, 160, 160)
        across = torch.arange(-7, 8.0, device=device)
        disc = (across[:, None].square() + across.square() <= 36).float().expand(1, 15, 15)
        psf = disc / disc.sum((-2, -1), keepdim=True)
        capture, truth = flat_capture(scene, psf, border="valid"), scene[..., 7:-7, 7:-7]
        edge = {}
        for border in BORDERS:
            error = (tikhonov(capture, psf, 1e-2, prior=capture, border=border) - truth).square()
            edge[border] = ((error.sum() - error[..., 15:-15, 15:-15].sum()) / (146**2 - 116**2)).sqrt()
        assert edge["circular"] > 4 * edge["smooth"]
        assert edge["smooth"] < 0.03

    @borders
    @pytest.mark.parametrize("shape", [(1, 1), (1, 30), (2, 3), (17, 4), (31, 37)])
    def test_cardinality_any_size(self, border, shape, device, dtype):
        capture, bank = torch.rand(2, 2, *shape, device=device, dtype=dtype), make_bank(3, 2, 7, device=device)
        out, layers = Tikhonov(border=border)(capture, bank), TikhonovLayers(border=border)(capture, bank)
        assert (out.shape, layers.shape) == (capture.shape, (2, 3, 2, *shape))
        assert (out.dtype, layers.dtype) == (dtype, dtype)
        assert out.isfinite().all()
        assert layers.isfinite().all()
