from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.render import assign_layers
from kornia_tidy.render.layers import layer_weights, present_layers, weight_of_layer
from tests.base import BaseTester
from tests.render.scenes import brute_weights

NODES = (-20.0, -11.0, -4.0, 0.0, 7.0, 20.0)


def row(*values, **like):
    return torch.tensor(values, **like).view(1, 1, 1, -1)


class TestLayerWeights(BaseTester):
    @pytest.mark.parametrize("mode", ["nearest", "linear"])
    def test_feature_equals_numpy_at_uneven_nodes(self, mode, device):
        defocus = torch.linspace(-23, 23, 1001, device=device, dtype=torch.float64).view(1, 1, 7, 143)
        weights = layer_weights(defocus, torch.tensor(NODES, device=device, dtype=torch.float64), mode)
        expected = brute_weights(defocus[0, 0].cpu().numpy(), np.array(NODES), mode)
        self.assert_close(weights[0].cpu(), torch.from_numpy(expected), rtol=0, atol=1e-14)

    def test_feature_one_layer_takes_all(self, device, dtype):
        nodes = torch.tensor([3.0], device=device, dtype=dtype)
        for mode in ("nearest", "linear"):
            assert layer_weights(row(-50.0, 3.0, 7.0, device=device, dtype=dtype), nodes, mode).eq(1).all()

    def test_feature_linear_on_the_nodes_is_one_hot(self, device, dtype):
        nodes = torch.tensor(NODES, device=device, dtype=dtype)
        weights = layer_weights(nodes.view(1, 1, 1, -1), nodes, "linear")
        assert torch.equal(weights[0, :, 0], torch.eye(6, device=device, dtype=dtype))

    def test_convention_half_way_is_the_lower_layer(self, device, dtype):
        nodes = torch.tensor([-2.0, 0.0, 4.0], device=device, dtype=dtype)
        weights = layer_weights(row(-1.0, 2.0, device=device, dtype=dtype), nodes, "nearest")
        assert weights[0, :, 0].T.tolist() == [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]

    @given(st.lists(st.floats(-30, 30, width=32), min_size=1, max_size=20), st.sampled_from(["nearest", "linear"]))
    @settings(max_examples=100)
    def test_property_weights_sum_to_exactly_one(self, values, mode):
        weights = layer_weights(row(*values), torch.tensor(NODES), mode)
        assert weights.sum(1).eq(1).all()
        assert weights.ge(0).all()

    def test_property_linear_weights_give_the_defocus_back(self, device):
        nodes = torch.tensor(NODES, device=device, dtype=torch.float64)
        defocus = torch.empty(1, 1, 8, 8, device=device, dtype=torch.float64).uniform_(-20, 20)
        mean = (layer_weights(defocus, nodes, "linear") * nodes.view(1, -1, 1, 1)).sum(1, keepdim=True)
        self.assert_close(mean, defocus, rtol=0, atol=1e-13)

    def test_convention_the_slope_on_a_node_is_that_of_the_interval_above(self, device, dtype):
        nodes = torch.tensor([-2.0, 0.0, 4.0], device=device, dtype=dtype)
        defocus = row(-2.0, 0.0, 4.0, device=device, dtype=dtype).requires_grad_()
        for layer, expected in ((1, [0.5, -0.25, -0.25]), (2, [0.0, 0.25, 0.25])):
            weight = weight_of_layer(*assign_layers(defocus, nodes, "linear"), layer)
            assert torch.autograd.grad(weight.sum(), defocus)[0].flatten().tolist() == expected

    def test_feature_nearest_has_no_gradient(self, device, dtype):
        defocus = row(-3.0, 1.0, device=device, dtype=dtype).requires_grad_()
        assert not layer_weights(defocus, torch.tensor(NODES, device=device, dtype=dtype), "nearest").requires_grad

    def test_feature_any_memory_layout(self, device):
        defocus = torch.rand(4, 6, device=device).T.view(1, 1, 6, 4)
        nodes = torch.tensor([0.0, 9.0, 0.5, 9.0, 1.0], device=device)[::2]
        assert torch.equal(
            layer_weights(defocus, nodes, "linear"), layer_weights(defocus.contiguous(), nodes, "linear")
        )

    def test_exception_unknown_mode(self):
        with pytest.raises(ValueError, match="layers must be one of 'nearest', 'linear', got 'cubic'"):
            layer_weights(row(0.0), torch.tensor(NODES), "cubic")

    @pytest.mark.parametrize("nodes", [(0.0, -1.0), (0.0, 0.0), (0.0, float("nan"))])
    def test_exception_nodes_that_do_not_ascend(self, nodes):
        with pytest.raises(ValueError, match=r"nodes must ascend strictly, got \[0.0, "):
            layer_weights(row(0.0), torch.tensor(nodes), "linear")


class TestPresentLayers(BaseTester):
    @pytest.mark.parametrize(
        ("defocus", "mode", "expected"),
        [
            ((-20.0,), "linear", [0]),
            ((-30.0, 99.0), "linear", [0, 5]),
            ((-19.0,), "linear", [0, 1]),
            ((0.0, 7.5), "linear", [3, 4, 5]),
            ((0.0, 7.5), "nearest", [3, 4]),
        ],
    )
    def test_feature_holds_the_layers_that_have_weight(self, defocus, mode, expected, device):
        defocus = row(*defocus, device=device)
        assert present_layers(*assign_layers(defocus, torch.tensor(NODES, device=device), mode), 6) == expected

    def test_feature_a_weight_of_zero_counts_where_its_slope_does_not(self, device):
        nodes = torch.tensor(NODES, device=device)
        defocus = row(0.0, device=device).requires_grad_()
        assert present_layers(*assign_layers(defocus, nodes, "linear"), 6) == [3, 4]
        with torch.no_grad():
            assert present_layers(*assign_layers(defocus, nodes, "linear"), 6) == [3]
