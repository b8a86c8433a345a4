"""Energies by the mutual intensity as an operator: values, gradients, refused arguments."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.kernels.mutual_intensity_ops import SOURCE, mutual_intensity_energies
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import OperatorTester, needs_compiler
from tests.psf.energies_tester import random_case


class TestMutualIntensityEnergies(OperatorTester):
    draw = staticmethod(kernel_shapes.energies)
    differentiable = (0, 1, 2)
    source = SOURCE

    def smallest(self):
        return mutual_intensity_energies(*random_case())

    @needs_compiler
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("seed", range(2))
    def test_dynamo_passes_the_checks_of_operators(self, seed):
        super().test_dynamo_passes_the_checks_of_operators(seed)

    @needs_compiler
    def test_gradcheck_twice(self):
        case = [x.requires_grad_() for x in random_case()]
        assert torch.autograd.gradcheck(mutual_intensity_energies, case, fast_mode=True)
        assert torch.autograd.gradgradcheck(mutual_intensity_energies, case, fast_mode=True)

    @needs_compiler
    def test_feature_conjugated_and_transposed_memory(self):
        """Views whose conjugation torch keeps as a bit."""
        field, weights, kernels = random_case()
        expected = mutual_intensity_energies(field.conj().resolve_conj(), weights, kernels.conj().resolve_conj())
        assert torch.equal(mutual_intensity_energies(field.conj(), weights, kernels.conj()), expected)
        turned = field.mT.contiguous().mT, weights, kernels.transpose(1, 2).contiguous().transpose(1, 2)
        assert torch.equal(mutual_intensity_energies(*turned), mutual_intensity_energies(field, weights, kernels))

    @pytest.mark.parametrize(
        ("changed", "error", "words"),
        [
            (lambda u, w, k: (u.real, w, k), TypeError, "field must be complex64 or complex128, got torch.float64"),
            (lambda u, w, k: (u, w.float(), k), TypeError, "weights must be .*float64, got .*32"),
            (lambda u, w, k: (u, w, k.to(torch.complex64)), TypeError, "kernels must be .*complex128, got .*64"),
            (lambda u, w, k: (u[0], w, k), ValueError, r"field must have shape \(K, N, N\), got \(7, 7\)"),
            (lambda u, w, k: (u, w[:2], k), ValueError, r"weights must have shape \(3\), got \(2,\)"),
            (lambda u, w, k: (u, w, k[..., :5]), ValueError, r"kernels must have shape .* got \(4, 5, 2, 5\)"),
        ],
    )
    def test_exception(self, changed, error, words):
        with pytest.raises(error, match=words):
            mutual_intensity_energies(*changed(*random_case()))
