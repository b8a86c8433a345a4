"""The renderer as one operator: torch's checks of it, and graphs that render as eager code does."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from kornia_tidy.render.compositing import COMPOSITING, gather, render
from tests.base import BaseTester
from tests.render.scenes import Bank, make_bank, make_scene

RENDER = torch.ops.kornia_tidy.render_layers.default
GRADIENTS = torch.ops.kornia_tidy.render_layers_gradients.default


def arguments(compositing="gather", *, layers="linear", border="reflect", method="auto", dtype=torch.float64):
    """Arguments of the operator: two images of 9x40 pixels, 4 layers of 5x5 pixels, stray light."""
    bank = make_bank(4, 2, 5, dtype=dtype, light=0.8, veil=True)
    image, defocus = make_scene(bank, 2, 9, 40)
    tensors = [x.requires_grad_() for x in (image, defocus, bank.defocus, bank.psfs, bank.veil)]
    return *tensors, compositing, layers, border, False, [], method


class Renderer(torch.nn.Module):
    """A renderer with a bank and its own compositing."""

    def __init__(self, bank: Bank, compositing: str = "gather", method: str = "auto", **options) -> None:
        super().__init__()
        self.bank, self.options = bank, {"compositing": compositing, "method": method, **options}

    def forward(self, image, defocus):
        return render(image, defocus, self.bank, **self.options)


class TestRenderLayers(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("border", ["reflect", "valid", "zero"])
    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_dynamo_passes_the_checks_of_operators(self, compositing, border, dtype):
        """Schema, fake tensors of any shape, gradients as registered, and the compiler's dispatch."""
        torch.library.opcheck(RENDER, arguments(compositing, border=border, dtype=dtype))

    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_dynamo_the_gradients_pass_the_checks_of_operators(self, compositing):
        given = [x.detach() if isinstance(x, torch.Tensor) else x for x in arguments(compositing)]
        for wanted in ([True] * 5, [False, True, False, True, False]):
            torch.library.opcheck(GRADIENTS, (*given, torch.randn(2, 2, 9, 40, dtype=torch.float64), wanted))

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("method", ["auto", "batched", "dense"])
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_dynamo_a_graph_renders_as_eager_code_does(self, compositing, layers, method, dtype):
        """To the last bit, gradients too, and for other layers than those that it was traced with."""
        bank = make_bank(6, 2, 5, dtype=dtype, light=0.8, veil=True)
        psfs, veil = bank.psfs.requires_grad_(), bank.veil.detach().requires_grad_()
        renderer = Renderer(Bank(psfs, bank.defocus, veil), compositing, method, layers=layers)
        compiled = torch.compile(renderer, fullgraph=True, backend="aot_eager")
        image, defocus = make_scene(bank, 2, 24, 40)
        for own in (defocus.clamp(max=-12), defocus):
            results = []
            for call in (renderer, compiled):
                coded = call(image, own)
                results.append((coded, *torch.autograd.grad(coded.square().mean(), (psfs, veil))))
            for expected, got in zip(*results, strict=True):
                assert torch.equal(got, expected)

    def test_dynamo_the_graph_holds_one_operator_and_no_transform(self):
        graphs = []

        def keep(module, inputs):
            graphs.append(module.graph)
            return module

        bank = make_bank(4, 2, 5)
        torch.compile(Renderer(bank), fullgraph=True, backend=keep)(*make_scene(bank))
        called = [node.target for graph in graphs for node in graph.nodes if node.op == "call_function"]
        assert [target for target in called if "kornia_tidy" in str(target)] == [torch.ops.kornia_tidy.render_layers]
        assert not [target for target in called if "fft" in str(target)]

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_dynamo_function_transforms_inside_a_graph_take_plain_operations(self, compositing):
        bank = make_bank(4, 2, 5, light=0.8, veil=True)
        image, defocus = make_scene(bank)

        def gradient(image):
            return torch.func.grad(lambda x: render(x, defocus, bank, compositing).square().sum())(image)

        expected = torch.autograd.grad(
            render(image.requires_grad_(), defocus, bank, compositing).square().sum(), image
        )[0]
        compiled = torch.compile(gradient, fullgraph=True, backend="aot_eager")
        self.assert_close(compiled(image.detach()), expected, rtol=0, atol=1e-12)

    def test_dynamo_an_exported_graph_renders_as_eager_code_does(self):
        bank = make_bank(4, 2, 5)
        scene, other = make_scene(bank), make_scene(bank)
        renderer = Renderer(bank)
        exported = torch.export.export(renderer, scene).module()
        assert torch.equal(exported(*other), renderer(*other))

    @pytest.mark.parametrize("compositing", COMPOSITING)
    def test_feature_gradients_are_the_same_while_operations_are_counted(self, compositing):
        """A dispatch mode has torch call operators with autograd and conjugation switched off."""
        inputs = arguments(compositing)
        expected = torch.autograd.grad(RENDER(*inputs).square().sum(), inputs[:5])
        with FlopCounterMode(display=False):
            got = torch.autograd.grad(RENDER(*inputs).square().sum(), inputs[:5])
        for one, other in zip(expected, got, strict=True):
            assert torch.equal(one, other)

    @pytest.mark.parametrize("border", ["reflect", "valid"])
    def test_cardinality_tensors_without_memory(self, border):
        given = arguments(border=border)
        unread = [x.to("meta") if isinstance(x, torch.Tensor) else x for x in given]
        assert RENDER(*unread).shape == RENDER(*given).shape

    def test_feature_nearest_layers_give_defocus_and_nodes_no_gradient(self):
        scene = arguments()[:5]
        found = torch.autograd.grad(gather(*scene, layers="nearest").sum(), scene, allow_unused=True)
        assert [x is None for x in found] == [False, True, True, False, False]

    @pytest.mark.parametrize("compositing", COMPOSITING)
    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_feature_gradients_have_the_types_of_the_inputs(self, half, compositing):
        bank = make_bank(4, 2, 5, dtype=torch.float32)
        image, defocus = (x.requires_grad_() for x in make_scene(bank, 1, 9, 40))
        coded = render(image.to(half), defocus.double(), Bank(bank.psfs.requires_grad_(), bank.defocus), compositing)
        assert coded.dtype == half
        coded.float().sum().backward()
        assert all(bool(x.grad.isfinite().all()) for x in (image, defocus, bank.psfs))
