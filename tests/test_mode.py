"""How torch runs: what each way of tracing is told apart by."""

import threading

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from kornia_tidy.mode import Mode, torch_mode, values_unread
from tests.base import BaseTester

ACCELERATOR = torch.device("cuda")


def seen_by(transform, x: Tensor) -> Mode:
    """Return the mode that a function finds itself in under a transform of it."""
    found = []

    def function(x: Tensor) -> Tensor:
        found.append(torch_mode())
        return x.sum()

    transform(function)(x)
    return found[0]


class TestMode(BaseTester):
    def test_feature_values_are_known_under_derivatives_alone(self):
        mode = seen_by(torch.func.grad, torch.ones(2))
        assert mode == Mode.TRANSFORM
        assert mode & Mode.TRACED

    def test_feature_vmap_hides_values_outside_and_inside_of_derivatives(self):
        def outside(f):
            return torch.vmap(torch.func.grad(f))

        def inside(f):
            return torch.func.grad(lambda x: torch.vmap(f)(x).sum())

        for transform in (torch.vmap, outside, inside):
            assert seen_by(transform, torch.ones(2)) == Mode.TRACED

    def test_feature_forward_mode_is_a_transform(self):
        with forward_ad.dual_level():
            assert torch_mode() == Mode.TRANSFORM

    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    def test_feature_torchscript_hides_values(self):
        assert seen_by(lambda f: lambda x: torch.jit.trace(f, x), torch.ones(2)) == Mode.GRAPH

    def test_dynamo(self):
        def named(x: Tensor) -> Tensor:
            mode = torch_mode()
            return x + 1 * (Mode.GRAPH in mode) + 2 * (Mode.TRANSFORM in mode)

        x = torch.zeros(())
        self.assert_close(torch.compile(named, backend="eager", fullgraph=True)(x), x + 1)
        derivative = torch.func.grad(lambda x: x * named(x).detach())
        self.assert_close(torch.compile(derivative, backend="eager", fullgraph=True)(x), x + 3)


class TestValuesUnread(BaseTester):
    def test_feature_holds_for_its_block_and_thread(self):
        elsewhere = []
        with values_unread(ACCELERATOR), values_unread(torch.device("cpu")):
            assert torch_mode() == Mode.UNREAD
            thread = threading.Thread(target=lambda: elsewhere.append(torch_mode()))
            thread.start()
            thread.join()
        assert elsewhere == [torch_mode()] == [Mode.EAGER]

    def test_feature_changes_nothing_on_the_cpu_and_where_torch_traces(self):
        with values_unread(torch.device("cpu")):
            assert torch_mode() == Mode.EAGER

        def unread(x: Tensor) -> Tensor:
            with values_unread(ACCELERATOR):
                assert torch_mode() == Mode.TRANSFORM
            return x

        torch.func.grad(unread)(torch.ones(()))

    def test_exception_ends_it(self):
        with pytest.raises(ValueError, match="of the block"), values_unread(ACCELERATOR):
            raise ValueError("of the block")
        assert torch_mode() == Mode.EAGER
