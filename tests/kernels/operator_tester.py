"""What the tests of the operators share: random shapes against the definition, and torch's checks of operators."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from kornia_tidy.kernels import (
    gather_ops,
    mutual_intensity_ops,
    occlusion_ops,
    overlap_ops,
    pixel_ops,
    scattered_ops,
)
from kornia_tidy.kernels.build import build
from kornia_tidy.kernels.compiler import NotBuiltError
from tests.base import BaseTester
from tests.kernels.kernel_shapes import Call

MODULES = (gather_ops, overlap_ops, occlusion_ops, mutual_intensity_ops, scattered_ops, pixel_ops)
MISSING = next((why for m in MODULES if (why := build(m.SOURCE, torch.float32).remark)), "")
needs_compiler = pytest.mark.skipif(
    any(build(m.SOURCE, torch.float32).library is None for m in MODULES), reason=f"no compiled code: {MISSING}"
)


class OperatorTester(BaseTester):
    """Tests of an operator: ``draw`` makes random calls of it, ``differentiable`` numbers arguments with gradients."""

    draw: ClassVar[Callable[[random.Random], Call]]
    differentiable: ClassVar[tuple[int, ...]] = ()
    source: ClassVar[Path]

    @needs_compiler
    @pytest.mark.parametrize("threads", [1, 2])
    def test_smoke_with_one_and_two_threads(self, threads):
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(threads)
            got = self.draw(random.Random(0)).got
        finally:
            torch.set_num_threads(before)
        assert got.is_contiguous()
        assert bool(got.isfinite().all())

    @needs_compiler
    @pytest.mark.parametrize("seed", range(12))
    def test_feature_equals_the_definition_in_float64_within_round_off(self, seed):
        torch.manual_seed(seed)
        call = self.draw(random.Random(seed))
        assert call.error() <= 1, call.about

    @needs_compiler
    @pytest.mark.parametrize("seed", range(2))
    def test_dynamo_passes_the_checks_of_operators(self, seed):
        """Schema, fake tensors of any shape, gradients as registered, and the compiler's dispatch."""
        torch.manual_seed(seed)
        draw = random.Random(seed)
        call = next(call for call in iter(lambda: self.draw(draw), None) if call.products < 1e5)
        arguments = tuple(
            x.detach().requires_grad_() if n in self.differentiable and x is not None else x
            for n, x in enumerate(call.arguments)
        )
        checks = ("test_schema", "test_autograd_registration", "test_faketensor", "test_aot_dispatch_dynamic")
        torch.library.opcheck(call.operator, arguments, test_utils=checks[: 4 - seed])  # compiled once, for any shape

    @needs_compiler
    def test_dynamo_is_one_node_of_a_whole_graph(self):
        call = self.draw(random.Random(1))
        compiled = torch.compile(call.operator, fullgraph=True, backend="aot_eager")
        assert torch.equal(compiled(*call.arguments), call.got)

    @needs_compiler
    @pytest.mark.parametrize("seed", range(4))
    def test_cardinality_tensors_without_memory(self, seed):
        """The fake implementation gives the shape, strides and type of the result."""
        call = self.draw(random.Random(seed))
        fake = call.operator(*(x.to("meta") if isinstance(x, Tensor) else x for x in call.arguments))
        assert fake.is_meta
        assert (fake.shape, fake.dtype, fake.stride()) == (call.got.shape, call.got.dtype, call.got.stride())

    def test_exception_without_a_compiler(self, monkeypatch):
        monkeypatch.setattr("kornia_tidy.kernels.build.compiled", lambda source, dtype: None)
        with pytest.raises(NotBuiltError, match=rf"{self.source.name} is not compiled: "):
            self.smallest()

    def smallest(self) -> Tensor:
        """Call the operator with valid arguments."""
        raise NotImplementedError


class SceneOperatorTester(OperatorTester):
    """Tests of an operator of a layered scene, which is not differentiated: the renderer is."""

    @needs_compiler
    def test_exception_it_has_no_gradient(self):
        call = self.draw(random.Random(0))
        recorded = [x.detach().requires_grad_() if is_light(x) else x for x in call.arguments]
        made = call.operator(*recorded)
        with pytest.raises(NotImplementedError, match=rf"{call.name} has no gradient: differentiate .*\.render"):
            (made[0] if isinstance(made, list) else made).sum().backward()


def other_dtype(x: Tensor) -> Tensor:
    return x.float() if x.dtype == torch.float64 else x.double()


class LayeredSceneTester(SceneOperatorTester):
    """Tests of an operator that takes light, PSFs and labels by name: ``operator``, with arguments from ``scene``."""

    @pytest.mark.parametrize(
        ("name", "change", "error", "words"),
        [
            ("plane", Tensor.half, TypeError, "plane must be float32 or float64, got torch.float16"),
            ("psfs", other_dtype, TypeError, "psfs must be torch.float.*, got torch.float"),
            ("layer_weight", other_dtype, TypeError, "layer_weight must be torch.float.*, got torch.float"),
            ("plane", lambda x: x[0, 0], ValueError, r"plane must have shape \(B, C, Y, X\), got \([0-9]+, [0-9]+\)"),
            ("psfs", lambda x: x[..., :2, :2], ValueError, "psfs must have an odd side, got 2"),
            ("psfs", lambda x: x[:, :1], ValueError, r"psfs must have shape \(D, 2, P, P\), got"),
            ("psfs", lambda x: x[..., 2:, :], ValueError, r"psfs must have shape \(D, 2, P, P\), got"),
            ("layer_index", lambda x: x[..., 1:], ValueError, "layer_index must have shape .*, got"),
            ("layer_weight", lambda x: x.repeat(3, 1, 1), ValueError, "layer_weight must have shape .*, got"),
        ],
    )
    def test_exception_of_the_scene(self, name, change, error, words):
        given = self.scene()
        with pytest.raises(error, match=words):
            self.operator(**{**given, name: change(given[name])})


def is_light(x: object) -> bool:
    return isinstance(x, Tensor) and x.is_floating_point()
