from __future__ import annotations

import math

import pytest
import torch
from torch._dynamo.testing import CompileCounter

from kornia_tidy import PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.psf import Pupil, exact_psf_bank, psf_ops
from kornia_tidy.psf.psf_cache import PSFMemory
from kornia_tidy.psf.psf_ops import operator_psf_bank
from tests.base import BaseTester

LENS = [1.0, 1.1], [-3.0, 0.0, 2.0], 2e-7, 9, 1e-2, [0.0, 0.3]  # dispersion to chromatic defocus
SPECTRUM = Spectrum((530e-9, 480e-9), ((1, 2), (3, 1)))


def masks(states=2, side=7, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    phase = 6 * torch.rand(states, side, side, generator=generator, dtype=dtype)
    weights = torch.rand(states, generator=generator, dtype=dtype)
    return phase, weights / weights.sum()


def pupil(side=7, fill_factor=1.0):
    return Pupil(0.5 + 0.5 * torch.rand(side, side, generator=torch.Generator().manual_seed(1)), 0.3, fill_factor)


def arguments(phase, weights, *, basis=()):
    rows = [x for row in SPECTRUM.weights for x in row]
    dispersion, nodes, step, window, tolerance, shifts = LENS
    shown = phase, weights, pupil().amplitude, 0.3, 1.0, pupil().light, list(SPECTRUM.wavelengths)
    return *shown, rows, list(basis), dispersion, shifts, nodes, step, window, tolerance


@pytest.fixture(autouse=True)
def forgetful(monkeypatch):
    """No PSFs of other tests."""
    monkeypatch.setattr(psf_ops, "MEMORY", PSFMemory())


class TestOperatorPSFBank(BaseTester):
    @pytest.mark.parametrize("fill_factor", [1.0, 0.8])
    @pytest.mark.parametrize("states", [1, 2, 9])
    def test_feature_equals_the_bank(self, states, fill_factor, dtype):
        """PSFs, their energy and the gradients, by waves and by the mutual intensity; asked for twice."""
        banks, gradients = [], []
        for make in (exact_psf_bank, operator_psf_bank, operator_psf_bank):
            phase, weights = (x.to(dtype).requires_grad_() for x in masks(states))
            bank = make(phase, weights, pupil(fill_factor=fill_factor), SPECTRUM, *LENS)
            slope = torch.linspace(0, 1, bank.psfs.numel(), dtype=dtype).view_as(bank.psfs)
            gradients.append(torch.autograd.grad((bank.psfs * slope).sum(), (phase, weights)))
            banks.append(bank)
        for bank, found in zip(banks[1:], gradients[1:], strict=True):
            for part in ("psfs", "defocus", "energy"):
                self.assert_close(getattr(bank, part), getattr(banks[0], part))
            for one, other in zip(found, gradients[0], strict=True):
                scale = float(other.abs().max())
                self.assert_close(one / scale, other / scale, atol=1e-5 if dtype == torch.float32 else 1e-10, rtol=0)

    def test_feature_reflectances_have_planes(self):
        spectrum = Spectrum.rgb()
        spectrum = Spectrum(spectrum.wavelengths, spectrum.weights, ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
        lens = pupil(), spectrum, [1.0] * 3, *LENS[1:5], [0.0] * 3
        expected = exact_psf_bank(*masks(), *lens).psfs
        self.assert_close(operator_psf_bank(*masks(), *lens).psfs, expected)
        assert expected.shape[1] == 9

    def test_feature_remembered_psfs_are_those_of_what_is_asked(self):
        """Whatever changes in place or by value: masks, weights, aperture, nodes, sensor."""
        (phase, weights), aperture = masks(), pupil()
        lens = list(LENS)
        for change in (
            lambda: phase.add_(0.1),
            lambda: weights.copy_(weights.flip(0)),
            lambda: aperture.amplitude.mul_(0.5),
            lambda: lens.__setitem__(1, [-1.0, 0.0]),
            lambda: lens.__setitem__(2, 3e-7),
        ):
            operator_psf_bank(phase, weights, aperture, SPECTRUM, *lens)
            change()
            found = operator_psf_bank(phase, weights, aperture, SPECTRUM, *lens).psfs
            own = Pupil(aperture.amplitude, aperture.cell_pitch, light=aperture.light)
            self.assert_close(found, exact_psf_bank(phase, weights, own, SPECTRUM, *lens).psfs)

    def test_feature_same_psfs_are_computed_once(self, monkeypatch):
        asked, computed = [], psf_ops._computed
        monkeypatch.setattr(psf_ops, "_computed", lambda *rest: asked.append(rest) or computed(*rest))
        first, second = (operator_psf_bank(*masks(), pupil(), SPECTRUM, *LENS).psfs for _ in range(2))
        assert len(asked) == 1
        assert torch.equal(first, second)
        assert first.data_ptr() != second.data_ptr()  # each may be written to

    def test_feature_large_banks_are_not_kept(self, monkeypatch):
        monkeypatch.setattr(psf_ops, "MEMORY", memory := PSFMemory(3 * 2 * 9 * 9 * 8 - 1))
        operator_psf_bank(*masks(), pupil(), SPECTRUM, *LENS)
        assert not memory._held

    def test_gradcheck(self):
        phase, weights = (x.requires_grad_() for x in masks(2, 3))
        lens = Pupil(torch.ones(3, 3), 0.6), SPECTRUM, LENS[0], [0.5], LENS[2], 3, *LENS[4:]

        def psfs(phase, weights):
            return operator_psf_bank(phase, weights, *lens).psfs

        assert torch.autograd.gradcheck(psfs, (phase, weights))
        assert torch.autograd.gradgradcheck(psfs, (phase, weights), fast_mode=True)

    @pytest.mark.parametrize("learnt", [(), (0,), (1,), (0, 1)])
    def test_dynamo_passes_the_checks_of_operators(self, learnt):
        shown = [x.requires_grad_(n in learnt) for n, x in enumerate(masks())]
        torch.library.opcheck(torch.ops.kornia_tidy.exact_psfs, arguments(*shown))

    def test_cardinality_tensors_without_memory(self):
        phase, weights = (x.to("meta") for x in masks(dtype=torch.float32))
        found = torch.ops.kornia_tidy.exact_psfs(*arguments(phase, weights))
        assert (found.shape, found.dtype, found.is_meta) == ((3, 2, 9, 9), torch.float32, True)


class TestCompiledCamera(BaseTester):
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    @pytest.mark.takes_seconds
    def test_dynamo_another_scene_does_not_compile_again(self, compositing):
        """Nor do other depths and masks that have learnt."""
        optics = TiDyOptics(PixelwiseMask(2), fidelity="draft", compositing=compositing, sensor=None)
        counter = CompileCounter()
        compiled = torch.compile(optics, backend=counter, fullgraph=True)
        generator = torch.Generator().manual_seed(0)
        for near, far in ((0.5, 0.9), (0.71, 0.71), (0.3, 100.0)):
            image = torch.rand(1, 3, 40, 40, generator=generator)
            depth = near + (far - near) * torch.rand(1, 1, 40, 40, generator=generator)
            with torch.no_grad():
                expected = optics(image, depth)
            self.assert_close(compiled(image, depth), expected, atol=1e-5, rtol=0)
            (gradient,) = torch.autograd.grad(compiled(image, depth).square().mean(), optics.masks.phase)
            assert math.isfinite(gradient.sum())
            with torch.no_grad():
                next(optics.masks.parameters()).mul_(1.1)
        assert counter.frame_count == 1

    def test_dynamo_cameras_that_differ_in_numbers(self):
        """Their pixels and tolerances are numbers that the compiler would leave open in a second graph."""
        generator = torch.Generator().manual_seed(0)
        image, depth = torch.rand(1, 3, 40, 40, generator=generator), torch.full((1, 1, 40, 40), 0.71)
        for fidelity in ("draft", "balanced"):
            optics = TiDyOptics(PixelwiseMask(1, generator=generator), fidelity=fidelity, sensor=None)
            compiled = torch.compile(optics, backend="eager", fullgraph=True)
            with torch.no_grad():
                self.assert_close(compiled(image, depth), optics(image, depth), atol=1e-5, rtol=0)
