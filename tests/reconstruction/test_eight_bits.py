from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.reconstruction.eight_bits import EightBits
from kornia_tidy.reconstruction.state_file import read_state, write_state
from tests.base import BaseTester
from tests.benchmarks.shipped_files import LEVELS, in_eight_bits

ROUNDING = 2.0**-24  # relative error of float32
LEAST = 2.0**-126  # smaller numbers have fewer digits


class TestEightBits(BaseTester):
    @settings(max_examples=40)
    @given(seed=st.integers(0, 10**6), size=st.floats(-50.0, 30.0), zero=st.booleans())
    def test_feature_an_error_is_half_a_step_of_its_output_channel(self, seed, size, zero):
        """Steps are 1/127 of the largest weight of the channel; the quotient, its product and the scale are rounded."""
        weight = torch.randn(4, 3, 3, 3, generator=torch.Generator().manual_seed(seed)) * 10.0**size
        weight[1] *= 1e-3
        weight[2] *= not zero
        found = in_eight_bits({"a": weight}, {"a"})["a"].weight()
        largest = weight.abs().amax((1, 2, 3), keepdim=True)
        allowed = largest / LEVELS * 0.5 + 4 * ROUNDING * largest + LEAST
        assert ((found - weight).abs() <= allowed).all()

    def test_feature_only_convolutions_are_rounded_so(self):
        weights = {
            "weight": torch.randn(4, 3, 1, 1),
            "bias": torch.randn(4),
            "beta": torch.randn(1, 4, 1, 1),
            "steps": torch.tensor(3),
            "psfs": torch.randn(2, 3, 5, 5),
        }
        found = in_eight_bits(weights, {"weight", "bias", "beta", "steps"})
        assert isinstance(found["weight"], EightBits)
        assert found["weight"].values.dtype == torch.int8
        for name in ("bias", "beta"):
            assert torch.equal(found[name], weights[name].half())
        for name in ("steps", "psfs"):
            assert found[name] is weights[name]

    def test_feature_a_file_holds_eight_bits_and_is_read_as_the_weight(self, tmp_path):
        rounded = in_eight_bits({"a": torch.randn(64, 64, 3, 3)}, {"a"})
        write_state(tmp_path / "a", {"state_dict": rounded})
        assert (tmp_path / "a").stat().st_size < 64 * 64 * 9 + 64 * 4 + 1024  # and a header
        found = read_state(tmp_path / "a")["state_dict"]["a"]
        assert found.dtype == torch.float32
        assert torch.equal(found, rounded["a"].weight())

    @pytest.mark.parametrize(
        ("values", "scale", "sentence"),
        [
            (torch.zeros(4, 1, 1, 1, dtype=torch.int8), torch.ones(5, 1, 1, 1), "does not fit a weight of"),
            (torch.zeros(1, 9, 1, 1, dtype=torch.int8), torch.ones(9, 1, 1, 1), "does not fit a weight of"),
            (torch.zeros(4, 1, 1, 1, dtype=torch.int8), torch.ones(4), "does not fit a weight of"),
            (torch.zeros(4, 1, 1, 1), torch.ones(4, 1, 1, 1), "eight bits is torch.float32"),
        ],
    )
    def test_exception_a_damaged_file(self, values, scale, sentence, tmp_path):
        """None is spread over a larger weight than the file holds."""
        write_state(tmp_path / "a", {"a": EightBits(values, scale)})
        with pytest.raises(ValueError, match=sentence):
            read_state(tmp_path / "a")

    @pytest.mark.parametrize("value", [torch.nan, torch.inf])
    def test_exception_not_finite(self, value):
        with pytest.raises(ValueError, match="first is not finite"):
            in_eight_bits({"first": torch.full((2, 1, 1, 1), value)}, {"first"})

    def test_exception_beyond_the_range_of_others(self):
        with pytest.raises(ValueError, match="bias is beyond the range of float16, 65504: 70000"):
            in_eight_bits({"bias": torch.tensor([70000.0])}, {"bias"})
