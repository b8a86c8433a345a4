"""What holds for each way to sum the energies of waves."""

from __future__ import annotations

import pytest
import torch

from tests.base import BaseTester
from tests.rounding import gamma, magnitude


def written_out(field: torch.Tensor, weights: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
    wave = torch.einsum("dpqn,knm,drsm->dkpqrs", kernels, field, kernels)
    return torch.einsum("k,dkpqrs->dpr", weights, wave.real.square() + wave.imag.square())


def random_case(states=3, cells=7, depths=4, window=5, order=2, dtype=torch.complex128):
    field = torch.randn(states, cells, cells, dtype=torch.complex128)
    kernels = torch.randn(depths, window, order, cells, dtype=torch.complex128)
    weights = torch.rand(states, dtype=torch.float64)
    return field.to(dtype), weights.to(field.to(dtype).real.dtype), kernels.to(dtype)


def round_off(field, weights, kernels):
    r"""Bound the error of energies :math:`E = \sum w |\sum_n K_n v_n|^2` with :math:`v = U K`, in float64.

    Each v is a sum of 2N real products, so off by :math:`e = \gamma_{2N} |U| |K|`, which moves E by no more than
    :math:`\sum w (2 \sum_n |K_n| |v_n| \sum_n |K_n| e_n)`. After that each of the products of which E is the sum, of
    two v and two K in :math:`\sum w (\sum_n |K_n| |v_n|)^2` together, is rounded no more often than it is added: N^2
    times over pairs of cells, 2 K q over waves, 2 q over points; and 16 times as weights, real and imaginary parts are
    put together. Moduli are |Re| + |Im|.
    """
    states, cells = field.shape[:2]
    order, dtype = kernels.shape[2], field.real.dtype
    k, u, w = magnitude(kernels).double(), magnitude(field).double(), weights.detach().double()
    off = gamma(2 * cells, dtype) * torch.einsum("knm,drsm->dkrsn", u, k)
    wave = torch.einsum("knm,drsm->dkrsn", field.to(torch.complex128), kernels.to(torch.complex128))
    seen, lost = (torch.einsum("dpqn,dkrsn->dkpqrs", k, x) for x in (magnitude(wave) + off, off))
    roundings = cells**2 + 2 * states * order + 2 * order + 16
    return torch.einsum("k,dkpqrs->drp", w, 2 * seen * lost + gamma(roundings, dtype) * seen.square())


def gradient_round_off(case, light, dtype=torch.float64):
    """Bound the error of the gradients of ``(energies * light).sum()`` to field, weights and kernels.

    A gradient is a sum of products of the same numbers, and its magnitudes' sum the gradient of positive ones. They are
    rounded as often as energies are, see :func:`round_off`, and once more for each pixel that is added.
    """
    field, _, kernels = case
    roundings = len(field[0]) ** 2 + 4 * len(field[0]) + 2 * (len(field) + 1) * kernels.shape[2] + 16
    roundings += kernels.shape[0] * kernels.shape[1] ** 2
    positive = [(magnitude(x + 0j) + (0j if x.is_complex() else 0)).requires_grad_() for x in case]
    total = torch.autograd.grad((written_out(*positive) * light.abs()).sum(), positive)
    return [2 * gamma(roundings, dtype) * magnitude(x + 0j) for x in total]


class EnergiesTester(BaseTester):
    """``energies`` is the way that is tested."""

    @staticmethod
    def assert_within(actual, expected, allowed) -> None:
        off = torch.view_as_real(actual + 0j) - torch.view_as_real(expected + 0j)
        assert bool((off.abs().amax(-1) <= 2 * allowed).all())  # both are off
        assert allowed.max() < 1e-3 * expected.abs().max()

    @pytest.mark.parametrize("precision", [torch.complex64, torch.complex128])
    def test_feature_equals_complex_products(self, precision):
        case = random_case(dtype=precision)
        expected = written_out(*(x.to(torch.complex128) if x.is_complex() else x.double() for x in case))
        got = self.energies(*case)
        assert got.dtype == case[1].dtype
        self.assert_within(got.double(), expected, round_off(*case))

    def test_feature_gradients_equal_those_of_complex_products(self):
        case = tuple(x.requires_grad_() for x in random_case())
        light = torch.randn(4, 5, 5, dtype=torch.float64)
        ours, theirs = (
            torch.autograd.grad((function(*case) * light).sum(), case) for function in (self.energies, written_out)
        )
        for one, two, allowed in zip(ours, theirs, gradient_round_off(case, light), strict=True):
            self.assert_within(one, two, allowed)

    @pytest.mark.parametrize("wanted", [(0,), (1,), (2,)])
    def test_feature_each_gradient_can_be_had_alone(self, wanted):
        case = random_case()
        own = [case[i].requires_grad_() for i in wanted]
        ours, theirs = (torch.autograd.grad(function(*case).sum(), own)[0] for function in (self.energies, written_out))
        self.assert_within(ours, theirs, gradient_round_off(case, torch.ones(()))[wanted[0]])

    def test_gradcheck_twice_in_field_weights_and_kernels(self):
        case = tuple(x.requires_grad_() for x in random_case(2, 3, 2, 3, 2))
        assert torch.autograd.gradcheck(self.energies, case, fast_mode=True)
        assert torch.autograd.gradgradcheck(self.energies, case, fast_mode=True)

    def test_feature_autocast_changes_nothing(self):
        case = random_case(dtype=torch.complex64)
        case[0].requires_grad_()
        plain = self.energies(*case)
        (expected,) = torch.autograd.grad(plain.sum(), case[0])
        with torch.autocast("cpu", dtype=torch.bfloat16):
            cast = self.energies(*case)
            (got,) = torch.autograd.grad(cast.sum(), case[0])
        assert torch.equal(cast, plain)
        assert torch.equal(got, expected)

    def test_feature_a_state_that_is_never_shown_keeps_a_finite_gradient(self):
        field, _, kernels = random_case(2)
        weights = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(self.energies(field, weights, kernels).sum(), weights)
        alone = self.energies(field[1:], torch.ones(1, dtype=torch.float64), kernels).sum()
        self.assert_close(gradient[1], alone)
