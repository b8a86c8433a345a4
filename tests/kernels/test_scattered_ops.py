"""Light from scattered points as an operator: values, gradients, threads, refused arguments."""

from __future__ import annotations

import random

import pytest
import torch

from kornia_tidy.kernels.scattered_ops import SOURCE, Points, Transform, scattered_light, scattered_light_by_torch
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import OperatorTester, needs_compiler


def a_case(seed: int = 2, dtype: torch.dtype = torch.float64) -> tuple:
    torch.manual_seed(seed)
    draw = random.Random(seed)
    return next(case for case in iter(lambda: kernel_shapes._scattered(draw)[0], None) if case[1].dtype == dtype)


def called(function, case):
    return function(*case[:2], Points(*case[2:6]), case[6], Transform(*case[7:10]), *case[10:])


class TestScatteredLight(OperatorTester):
    draw = staticmethod(kernel_shapes.scattered)
    differentiable = (0, 1)
    source = SOURCE

    def smallest(self):
        return called(scattered_light, a_case())

    @pytest.mark.parametrize("seed", range(6))
    def test_feature_plain_operations_equal_the_definition(self, seed):
        torch.manual_seed(seed)
        call = kernel_shapes.scattered(random.Random(seed))
        expected, allowed = call.truth()
        waves, weights, points, width, transform, *sums = call.arguments
        given = waves, weights, Points(*points), width, Transform(*transform), *sums
        got = scattered_light_by_torch(*given).double()
        assert bool(((got - expected).abs() <= allowed).all()), call.about

    @needs_compiler
    @pytest.mark.parametrize("seed", range(6))
    def test_feature_gradients_equal_those_of_plain_operations(self, seed):
        case = a_case(seed)
        ways = []
        for function in (scattered_light, scattered_light_by_torch):
            own = case[0].clone().requires_grad_(), case[1].clone().requires_grad_()
            light = called(function, (*own, *case[2:]))
            ways.append(torch.autograd.grad((light * torch.linspace(-1, 2, light.numel()).view_as(light)).sum(), own))
        for one, two in zip(*ways, strict=True):
            self.assert_close(one, two, atol=1e-11 * float(two.abs().max()), rtol=0)

    @needs_compiler
    def test_gradcheck_twice(self):
        case = next(case for case in map(a_case, range(20)) if case[3].shape[2] * case[10].numel() < 500)
        own = [x.requires_grad_() for x in case[:2]]
        light = lambda *given: called(scattered_light, (*given, *case[2:]))  # noqa: E731
        assert torch.autograd.gradcheck(light, own, fast_mode=True)
        assert torch.autograd.gradgradcheck(light, own, fast_mode=True)

    @needs_compiler
    @pytest.mark.parametrize("learnt", [0, 1])
    def test_gradcheck_twice_of_one_argument(self, learnt):
        case = next(case for case in map(a_case, range(20)) if case[3].shape[2] * case[10].numel() < 500)
        own = case[learnt].requires_grad_()
        light = lambda x: called(scattered_light, (*case[:learnt], x, *case[learnt + 1 :]))  # noqa: E731
        assert torch.autograd.gradgradcheck(light, own, fast_mode=True)

    @needs_compiler
    def test_feature_threads_and_depths_leave_every_bit(self):
        case = next(case for case in (a_case(seed, torch.float32) for seed in range(20)) if len(case[4]) == 3)
        before, found = torch.get_num_threads(), []
        try:
            for threads in (1, 2):
                torch.set_num_threads(threads)
                own = case[0].clone().requires_grad_()
                light = called(scattered_light, (own, *case[1:]))
                found.append((light.detach(), torch.autograd.grad(light.square().sum(), own)[0]))
        finally:
            torch.set_num_threads(before)
        assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))
        alone = called(scattered_light, (*case[:4], case[4][1:2], case[5][1:2], *case[6:]))
        assert torch.equal(alone[:, 0], found[0][0][:, 1])

    @pytest.mark.parametrize(
        ("at", "change", "error", "words"),
        [
            (0, lambda x: x.real, TypeError, "waves must be complex64 or complex128, got torch.float64"),
            (1, lambda x: x.float(), TypeError, "weights must be .*float64, got .*32"),
            (8, lambda x: x.float(), TypeError, "cosines must be"),
            (11, lambda x: x.float(), TypeError, "columns must be"),
            (3, lambda x: x.float(), TypeError, "values must be torch.float64, got torch.float32"),
            (2, lambda x: x.int(), TypeError, "cell must be torch.int64, got torch.int32"),
            (7, lambda x: x[:0], ValueError, "kernel and its width must be at least 1, got 0 coefficients and width"),
            (1, lambda x: x.repeat(2), ValueError, r"weights must have shape \(\d+\), got"),
            (3, lambda x: x[:, 1:], ValueError, r"values must have shape \(\d+, \d+, \d+, S\), got"),
            (9, lambda x: x[1:], ValueError, r"sines must have shape \(\d+, \d+\), got"),
            (10, lambda x: x[..., 1:], ValueError, r"columns must have shape \(\d+, \d+, \d+, \d+, \d+\), got"),
        ],
    )
    def test_exception(self, at, change, error, words):
        case = list(a_case())
        case[at] = change(case[at])
        with pytest.raises(error, match=words):
            called(scattered_light, case)

    @needs_compiler
    @pytest.mark.parametrize("beyond", [-9.0, 1e6, float("nan"), float("inf")])
    def test_exception_points_beyond_the_grid(self, beyond):
        case = list(a_case())
        case[3] = case[3].clone()
        case[3][0, 0, -1, -1] = beyond
        with pytest.raises(ValueError, match=r"points must lie in the grid of \d+ samples"):
            called(scattered_light, case)
        case[2] = case[2] + 100
        with pytest.raises(IndexError, match="cell must lie from 0 to"):
            called(scattered_light, case)


class TestScatteredLightGradients(OperatorTester):
    draw = staticmethod(kernel_shapes.scattered_gradient)
    source = SOURCE

    def smallest(self):
        case = a_case()
        light = torch.ones(len(case[10]), len(case[4]), *(case[10].shape[n] for n in (1, 2, 3, 3)), dtype=torch.float64)
        return torch.ops.kornia_tidy.scattered_light_gradients(*kernel_shapes.scattered_arguments(case), light)

    @needs_compiler
    def test_dynamo_is_one_node_of_a_whole_graph(self):
        pytest.skip("its results are a pair, and the operator is a node of a backward graph only")

    test_cardinality_tensors_without_memory = test_smoke_with_one_and_two_threads = None
