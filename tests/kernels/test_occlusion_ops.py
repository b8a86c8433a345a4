"""Occlusion by direct convolution as operators: values, refused arguments."""

from __future__ import annotations

import random
from typing import Any

import pytest
import torch

from kornia_tidy.kernels.occlusion_ops import (
    SOURCE,
    count_operations,
    occlusion_direct,
    occlusion_direct_gradients,
)
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import LayeredSceneTester, SceneOperatorTester, needs_compiler

OTHERS = (
    kernel_shapes.occlude_light_gradient,
    kernel_shapes.field_occlude_gradient,
    kernel_shapes.field_occlude_light_gradient,
)


def scene(**changes: Any) -> dict[str, Any]:
    """Arguments of ``occlusion_direct``: 2 images, 2 channels, 3 layers, 3x3 PSFs."""
    arguments = {
        "plane": torch.rand(2, 2, 11, 34),
        "psfs": torch.full((3, 2, 3, 3), 1 / 9),
        "layer_index": torch.randint(2, (1, 11, 34)).float(),
        "layer_weight": torch.rand(1, 11, 34),
    }
    return {**arguments, **changes}


class TestOcclusionDirect(LayeredSceneTester):
    scene, operator = staticmethod(scene), staticmethod(occlusion_direct)
    draw = staticmethod(kernel_shapes.occlude)
    source = SOURCE

    def smallest(self):
        return occlusion_direct(**scene())

    @needs_compiler
    def test_feature_layers_of_any_number_type(self):
        given = scene(layer_weight=None)
        expected = occlusion_direct(**given)
        for dtype in (torch.int64, torch.float64):
            assert torch.equal(occlusion_direct(**{**given, "layer_index": given["layer_index"].to(dtype)}), expected)

    @needs_compiler
    def test_feature_a_weight_of_one_is_the_next_layer(self):
        given = scene(layer_weight=torch.ones(1, 11, 34))
        expected = occlusion_direct(**{**given, "layer_index": given["layer_index"] + 1, "layer_weight": None})
        assert torch.equal(occlusion_direct(**given), expected)

    @needs_compiler
    def test_feature_operations_add_up_over_images_and_grow_with_outlines(self):
        psfs, columns = torch.zeros(3, 1, 5, 5), torch.arange(68)
        wide, narrow, weight = (x.float().expand(1, 36, 68) for x in (columns // 2 % 2, columns % 2, columns / 68))
        one, two = (count_operations(wide, weight, psfs, batch) for batch in (1, 2))
        assert two == 2 * one
        assert count_operations(narrow, None, psfs, 1) > count_operations(wide, None, psfs, 1)

    @pytest.mark.parametrize(
        ("changes", "error", "words"),
        [
            ({"psfs": torch.zeros(3, 2, 5, 5)}, ValueError, "at least 8x32 pixels, got 7x30"),
            ({"mean": torch.zeros(2, 2)}, ValueError, "a mean needs stray_light, got only mean"),
            ({"stray_light": torch.zeros(3, 2)}, ValueError, "a mean needs stray_light, got only stray_light"),
            ({"mean": torch.zeros(2, 2), "stray_light": torch.zeros(2, 2)}, ValueError, r"stray_light must .*\(3, 2\)"),
            ({"inside": torch.zeros(2, 11, 34)}, ValueError, r"have shape \(1, 11, 34\), got \(2, 11, 34\)"),
        ],
    )
    def test_exception(self, changes, error, words):
        with pytest.raises(error, match=words):
            occlusion_direct(**scene(**changes))

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            (
                {"psfs": torch.ones(1, 1, 3, 2, 3, 3), "mean": torch.ones(2, 2), "stray_light": torch.ones(3, 2)},
                "stray_light must be None where PSFs vary",
            ),
            ({}, r"over the field must have shape \(I, J, D, C, P, P\), got \(3, 2, 3, 3\)"),
        ],
    )
    def test_exception_over_the_field(self, changes, words):
        axis = torch.tensor([0, 9]), torch.zeros(1), torch.tensor([[[1.0], [0.0]]])
        with pytest.raises(ValueError, match=words):
            occlusion_direct(**scene(**changes), places=[*axis, torch.tensor([0, 32]), *axis[1:]])

    @needs_compiler
    def test_exception_tiles_that_are_too_large(self):
        one, two = (torch.tensor([[1.0], [0.0]]).expand(n, -1, -1) for n in (1, 2))
        places = [torch.tensor([0, 9]), torch.zeros(1), one, torch.tensor([0, 16, 32]), torch.zeros(2), two]
        with pytest.raises(ValueError, match=r"must ascend from 0 to 9 by 8 at most, got \[0, 9\]"):
            occlusion_direct(**scene(psfs=torch.ones(1, 1, 3, 2, 3, 3)), places=places)


class TestOcclusionOverField(SceneOperatorTester):
    draw = staticmethod(kernel_shapes.field_occlude)
    source = SOURCE

    def smallest(self):
        return occlusion_direct(**scene())


class TestOcclusionDirectGradients(SceneOperatorTester):
    draw = staticmethod(kernel_shapes.occlude_gradient)
    source = SOURCE

    def test_cardinality_tensors_without_memory(self):
        """Of a list, and so not as for the other operators."""
        arguments = kernel_shapes.occlude_gradient(random.Random(1)).arguments
        *planes, places, gradient, _ = arguments
        given = (None if x is None else x.to("meta") for x in planes)
        found = occlusion_direct_gradients(*given, places, gradient.to("meta"), [True] * 4)
        given = [arguments[n] for n in (0, 1, 4, 5) if arguments[n] is not None]
        assert [(x.shape, x.dtype, x.is_meta) for x in found] == [(x.shape, x.dtype, True) for x in given]

    @needs_compiler
    def test_dynamo_is_one_node_of_a_whole_graph(self):
        call = kernel_shapes.occlude_gradient(random.Random(1))
        compiled = torch.compile(call.operator, fullgraph=True, backend="aot_eager")
        assert torch.equal(compiled(*call.arguments)[0], call.got)

    def smallest(self):
        return self.of(torch.zeros(2, 2, 9, 32))

    @staticmethod
    def of(gradient):
        rest = dict.fromkeys(("mean", "stray_light", "inside", "places"))
        return occlusion_direct_gradients(**scene(), **rest, gradient=gradient, wanted=[False, True, False, True])

    @needs_compiler
    @pytest.mark.parametrize("seed", range(12))
    @pytest.mark.parametrize("draw", OTHERS)
    def test_feature_of_light_and_over_the_field_within_round_off(self, draw, seed):
        torch.manual_seed(seed)
        call = draw(random.Random(seed))
        assert call.error() <= 1, call.about

    @needs_compiler
    @pytest.mark.parametrize("draw", [kernel_shapes.occlude_gradient, *OTHERS])
    @pytest.mark.parametrize("threads", [1, 3, 50])
    def test_feature_the_same_every_time_with_as_many_threads(self, threads, draw):
        before, call = torch.get_num_threads(), draw(random.Random(3))
        try:
            torch.set_num_threads(threads)
            first, second = (call.operator(*call.arguments)[0] for _ in range(2))
        finally:
            torch.set_num_threads(before)
        assert torch.equal(first, second)
        assert (first - call.operator(*call.arguments)[0]).norm() <= 1e-5 * first.norm()

    def test_exception(self):
        with pytest.raises(ValueError, match=r"gradient must have shape \(2, 2, 9, 32\), got \(3,\)"):
            self.of(torch.zeros(3))
        with pytest.raises(TypeError, match=r"gradient must be .*32, got .*64"):
            self.of(torch.zeros(2, 2, 9, 32).double())
