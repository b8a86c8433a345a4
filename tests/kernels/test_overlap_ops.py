"""Gather and scatter by overlapping windows as operators: values, refused arguments."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from kornia_tidy.kernels.overlap_ops import (
    SOURCE,
    gather_overlap,
    overlap_psf_gradient,
    scatter_overlap,
)
from kornia_tidy.kernels.places import Places
from tests.kernels import kernel_shapes
from tests.kernels.operator_tester import LayeredSceneTester, SceneOperatorTester, needs_compiler


def scene(**changes: Any) -> dict[str, Any]:
    """Arguments of ``gather_overlap``: 2 images, 2 channels, 3 layers, 3x3 PSFs."""
    arguments = {
        "plane": torch.randn(2, 2, 6, 19, dtype=torch.float64),
        "psfs": torch.randn(3, 2, 3, 3, dtype=torch.float64),
        "layer_index": torch.randint(2, (2, 4, 17)),
        "layer_weight": torch.rand(2, 4, 17, dtype=torch.float64),
        "size": 16,
    }
    return {**arguments, **changes}


def over_field(**changes: Any) -> dict[str, Any]:
    """The same with 2x3 nodes over the field and two tiles side by side."""
    places = Places(
        torch.tensor([0, 4]),
        torch.tensor([1.5], dtype=torch.float64),
        torch.randn(1, 2, 2, dtype=torch.float64),
        torch.tensor([0, 9, 17]),
        torch.tensor([4.0, 12.5], dtype=torch.float64),
        torch.randn(2, 2, 3, dtype=torch.float64),
    )
    return scene(psfs=torch.randn(2, 3, 3, 2, 3, 3, dtype=torch.float64), places=places, **changes)


def pixels() -> torch.Tensor:
    return torch.randn(2, 2, 4, 17, dtype=torch.float64)


class TestGatherOverlap(LayeredSceneTester):
    scene, operator = staticmethod(scene), staticmethod(gather_overlap)
    source = SOURCE
    draw = staticmethod(kernel_shapes.overlap_gather)

    def smallest(self):
        return gather_overlap(**scene())

    @needs_compiler
    def test_feature_negated_and_shared_memory(self):
        """Views whose sign torch keeps as a bit, and planes that channels and images share."""
        given = scene()
        plane = torch.view_as_complex(torch.randn(2, 1, 6, 19, 2, dtype=torch.float64)).conj().imag
        plane = plane.expand(-1, 2, -1, -1)
        assert plane.is_neg()
        index = given["layer_index"][:1].expand(2, -1, -1)
        expected = gather_overlap(plane.clone().contiguous(), given["psfs"], index.contiguous(), None, 16)
        assert torch.equal(gather_overlap(plane, given["psfs"], index, None, 16), expected)

    @needs_compiler
    @pytest.mark.parametrize("layer", [-(2**63), -1, 3, 2**40])
    def test_exception_pixels_in_no_layer(self, layer):
        """A depth that is not a number may give any of these."""
        given = scene(layer_weight=None)
        given["layer_index"][1, 3, 16] = layer
        with pytest.raises(IndexError, match="a pixel lies in none of the 3 layers"):
            gather_overlap(**given)

    @needs_compiler
    def test_exception_a_share_of_a_layer_beyond_the_last(self):
        given = scene()
        given["layer_index"][0, 0, 0], given["layer_weight"][0, 0, 0] = 2, 0.5
        with pytest.raises(IndexError, match="a pixel lies in none of the 3 layers"):
            gather_overlap(**given)

    @needs_compiler
    def test_feature_no_image_and_windows_much_larger_than_the_image(self):
        given = scene()
        empty = {name: x[:0] if name not in ("psfs", "size") else x for name, x in given.items()}
        assert gather_overlap(**empty).shape == (0, 2, 4, 17)
        large, small = gather_overlap(**{**given, "size": 480}), gather_overlap(**given)
        self.assert_close(large, small, rtol=0, atol=1e-13)

    @needs_compiler
    @pytest.mark.parametrize("field", [False, True])
    def test_feature_threads_change_no_bit(self, field):
        before, got = torch.get_num_threads(), []
        if field:
            given, light = over_field(plane=torch.randn(2, 2, 6, 19, dtype=torch.float64)), pixels()
        else:
            given = scene(plane=torch.randn(2, 2, 82, 93, dtype=torch.float64), layer_weight=None)
            given["layer_index"] = torch.randint(3, (2, 80, 91))
            light = torch.randn(2, 2, 80, 91, dtype=torch.float64)
        spread = {**given, "pixels": light}
        del spread["plane"]
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                got.append((gather_overlap(**given), scatter_overlap(**spread)))
        finally:
            torch.set_num_threads(before)
        for gathered, scattered in got[1:]:
            assert torch.equal(gathered, got[0][0])
            assert torch.equal(scattered, got[0][1])

    @pytest.mark.parametrize(
        ("changes", "error", "words"),
        [
            ({"layer_index": torch.zeros(2, 4, 17)}, TypeError, "layer_index must be torch.int64, got torch.float32"),
            ({"layer_weight": None, "weight_gradient": True}, ValueError, "weight_gradient needs a layer_weight"),
            ({"size": 24}, ValueError, "size must be at least the PSFs' side 3, a multiple of 16 and .*, got 24"),
            ({"size": 112}, ValueError, "without prime factors but 2, 3 and 5, got 112"),
        ],
    )
    def test_exception(self, changes, error, words):
        with pytest.raises(error, match=words):
            gather_overlap(**scene(**changes))


class TestScatterOverlap(SceneOperatorTester):
    source = SOURCE
    draw = staticmethod(kernel_shapes.overlap_scatter)

    def smallest(self):
        given = scene()
        del given["plane"]
        return scatter_overlap(pixels(), **given)

    @needs_compiler
    def test_feature_conserves_light(self):
        """What a pixel sends out arrives: PSFs of sum one keep the sum."""
        given = scene(psfs=torch.rand(3, 2, 5, 5, dtype=torch.float64))
        given["psfs"] /= given["psfs"].sum((-2, -1), keepdim=True)
        del given["plane"]
        light = pixels()
        sums = scatter_overlap(light, **given).sum((-2, -1))
        self.assert_close(sums, light.sum((-2, -1)), rtol=0, atol=1e-12)


class TestOverlapPsfGradient(SceneOperatorTester):
    source = SOURCE
    draw = staticmethod(kernel_shapes.overlap_correlate)

    def smallest(self):
        given = scene()
        labels = given["layer_index"], given["layer_weight"]
        return overlap_psf_gradient(given["plane"], pixels(), *labels, 3, 16)

    @needs_compiler
    def test_feature_layers_without_a_pixel_have_no_gradient(self):
        given = scene(layer_index=torch.ones(2, 4, 17, dtype=torch.int64))
        got = overlap_psf_gradient(given["plane"], pixels(), given["layer_index"], None, 3, 16)
        assert [bool(layer.any()) for layer in got] == [False, True, False]


class TestGatherOverField(SceneOperatorTester):
    source = SOURCE
    draw = staticmethod(kernel_shapes.field_gather)

    def smallest(self):
        return gather_overlap(**over_field())

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"row_edges": [0, 5]}, "edges of tiles must ascend from 0 to 4 by 14 at most, got .0, 5."),
            ({"row_edges": [1, 4]}, "edges of tiles must ascend from 0 to 4 by 14 at most"),
            ({"column_edges": [0, 17, 17]}, "edges of tiles must ascend from 0 to 17 by 14 at most"),
            (
                {"column_edges": [0, 17]},
                r"edges of tiles must have shape \(3\), got \(2,\)",
            ),
        ],
    )
    def test_exception_places(self, changes, words):
        given = over_field()
        changed = {name: torch.tensor(edges) for name, edges in changes.items()}
        with pytest.raises(ValueError, match=words):
            gather_overlap(**{**given, "places": given["places"]._replace(**changed)})

    def test_exception_edges_of_another_dtype(self):
        given = over_field()
        places = given["places"]
        with pytest.raises(TypeError, match=r"edges of tiles must be torch\.int64, got torch\.int32"):
            gather_overlap(**{**given, "places": places._replace(row_edges=places.row_edges.int())})

    def test_exception_psfs_of_the_axis_with_places(self):
        with pytest.raises(ValueError, match=r"psfs over the field must have shape \(I, J, D, C, P, P\), got \(3, 2"):
            gather_overlap(**{**over_field(), "psfs": scene()["psfs"]})


class TestScatterOverField(SceneOperatorTester):
    source = SOURCE
    draw = staticmethod(kernel_shapes.field_scatter)

    def smallest(self):
        given = over_field()
        del given["plane"]
        return scatter_overlap(pixels(), **given)


class TestPsfGradientOverField(SceneOperatorTester):
    source = SOURCE
    draw = staticmethod(kernel_shapes.field_correlate)

    def smallest(self):
        given = over_field()
        labels = given["layer_index"], given["layer_weight"]
        return overlap_psf_gradient(given["plane"], pixels(), *labels, 3, 16, places=given["places"])
