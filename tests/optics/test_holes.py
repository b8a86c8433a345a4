"""Holes of depth maps: against brute force, in every data type, with gradients, and compiled."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.data import fill_holes
from tests.base import BaseTester

INF, NAN = float("inf"), float("nan")
WHOLE = (torch.uint8, torch.uint16, torch.int16, torch.int32, torch.uint32, torch.int64)
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def with_holes(*shape: int) -> torch.Tensor:
    """Depths of 0.5 to 1.5 m, of which three in five are holes and the last pixel of each map is known."""
    generator = torch.Generator().manual_seed(0)
    depth = torch.rand(shape, generator=generator) + 0.5
    known = torch.rand(shape, generator=generator) > 0.6
    known[..., -1, -1] = True
    return depth.where(known, -1.0)


class TestFillHoles(BaseTester):
    @pytest.mark.parametrize("kind", [*WHOLE, *FLOATS], ids=lambda kind: str(kind).removeprefix("torch."))
    def test_smoke(self, device, kind):
        filled, valid = fill_holes(torch.tensor([[5, 0, 0, 9]], device=device).to(kind))
        assert filled.dtype == kind
        assert (filled.tolist(), valid.tolist()) == ([[5, 5, 9, 9]], [[True, False, False, True]])

    @pytest.mark.parametrize("shape", [(7, 5), (1, 7, 5), (2, 1, 7, 5), (2, 3, 1, 7, 5), (0, 1, 7, 5), (1, 1, 1, 1)])
    def test_cardinality(self, shape):
        assert {part.shape for part in fill_holes(with_holes(*shape))} == {torch.Size(shape)}

    @pytest.mark.parametrize("shape", [(7, 5), (7, 5, 1), (3, 7, 5, 1), (0, 7, 5, 1), (1, 1)])
    @pytest.mark.parametrize("kind", ["uint8", "uint16", "int32", "float16", "float32", ">f8"])
    def test_cardinality_arrays(self, shape, kind):
        given = np.ones(shape, kind)
        given.reshape(-1)[1:3] = 0  # beyond the first value of a map
        filled, valid = fill_holes(given)
        assert (filled.shape, filled.dtype, valid.shape, valid.dtype) == (shape, given.dtype, shape, bool)
        assert (filled == 1).all()
        assert np.array_equal(valid, given > 0)

    @settings(max_examples=40)
    @given(st.integers(0, 2**31), st.floats(0.002, 0.9), st.integers(1, 40), st.integers(1, 40))
    def test_property_a_hole_takes_the_value_of_its_nearest_neighbour(self, seed, share, height, width):
        """Against brute force over all pairs of pixels; of several that are as near, any is right."""
        rng = np.random.default_rng(seed)
        known = rng.random((height, width)) < share
        known[rng.integers(height), rng.integers(width)] = True
        values = rng.permutation(height * width).reshape(height, width).astype(np.float32) + 1  # tells its pixel
        filled, valid = fill_holes(np.where(known, values, rng.choice([NAN, 0, -1, -INF], known.shape)))
        assert np.array_equal(valid, known)
        assert np.array_equal(filled[known], values[known])
        here = np.indices((height, width)).reshape(2, -1).T
        place = np.empty((height * width, 2), int)
        place[values.astype(int).ravel() - 1] = here
        taken = np.square(here - place[filled.astype(int).ravel() - 1]).sum(1)
        nearest = np.square(here[:, None] - here[known.ravel()][None]).sum(2).min(1)
        assert np.array_equal(taken, nearest)

    def test_feature_infinity_is_no_hole_and_fills_others(self):
        filled, valid = fill_holes(torch.tensor([[1.0, NAN, 0, -1, -INF, INF]]))
        assert filled.tolist() == [[1, 1, 1, INF, INF, INF]]
        assert valid.tolist() == [[True, False, False, False, False, True]]

    @pytest.mark.parametrize("beneath", [0.0, NAN, -1.0, 9.0, INF])
    def test_feature_masked_values_are_holes_whatever_lies_beneath(self, beneath):
        depth = np.ma.masked_array(np.array([[1.0, beneath, 3.0]]), mask=[[0, 1, 0]], fill_value=7)
        filled, valid = fill_holes(depth)
        assert (filled.tolist(), valid.tolist()) == ([[1, 1, 3]], [[True, False, True]])
        assert not isinstance(filled, np.ma.MaskedArray)

    def test_feature_tensors_and_arrays_are_filled_alike_map_by_map(self):
        depth = with_holes(4, 1, 9, 12)
        filled, valid = fill_holes(depth)
        for one, its_filled, its_valid in zip(depth, filled, valid, strict=True):
            found = fill_holes(one[0].numpy())
            assert np.array_equal(found[0], its_filled[0])
            assert np.array_equal(found[1], its_valid[0])

    def test_feature_without_holes_nothing_is_copied(self):
        depth = torch.ones(1, 4, 4)
        assert fill_holes(depth)[0] is depth
        assert np.shares_memory(fill_holes(depth[0].numpy())[0], depth.numpy())

    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    def test_dynamo_graph_is_whole(self):
        depth = with_holes(2, 1, 5, 6)
        compiled = torch.compile(fill_holes, backend="eager", fullgraph=True)
        for one in (depth, depth.abs()):
            for found, expected in zip(compiled(one), fill_holes(one), strict=True):
                assert torch.equal(found, expected)
        torch.library.opcheck(torch.ops.kornia_tidy.nearest_known.default, (depth > 0,))

    def test_exception_holes_alone(self):
        depth = torch.ones(2, 1, 3, 3)
        depth[1] = NAN
        message = "known at one pixel or more, and map 1 of 2 holds 0, NaN or masked pixels alone"
        with pytest.raises(ValueError, match=message):
            fill_holes(depth)
        with pytest.raises(ValueError, match=message):
            torch.compile(fill_holes, backend="eager")(depth)
        with pytest.raises(ValueError, match="map 0 of 1 holds 0, NaN or masked"):
            fill_holes(np.ma.masked_all((2, 3)))

    def test_exception_shapes_and_types(self):
        for wrong in (torch.ones(3), np.ones(3), np.ones((2, 3, 4)), np.ones((2, 3, 4, 5, 1))):
            with pytest.raises(ValueError, match=r"depth must be an? (tensor|array) \("):
                fill_holes(wrong)
        for wrong in (torch.ones(3, 3, dtype=torch.bool), np.ones((3, 3), complex), torch.ones(3, 3) * 1j):
            with pytest.raises(TypeError, match="depth must hold numbers, got"):
                fill_holes(wrong)
        with pytest.raises(TypeError, match=r"depth must be a tensor or an array, got 'a\.png'"):
            fill_holes("a.png")
        with pytest.raises(ValueError, match="must hold values"):
            fill_holes(torch.ones(3, 3, device="meta"))
