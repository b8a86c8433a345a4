from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction.half_precision import halved
from tests.base import BaseTester


class TestHalved(BaseTester):
    def test_feature_weights_keep_eleven_bits_and_others_all(self):
        weights = {"a": torch.randn(1000), "masks": torch.randn(10), "steps": torch.tensor(3)}
        found = halved(weights, {"a", "steps"})
        error = (found["a"].float() - weights["a"]).abs()
        assert (error <= (2.0**-11 * weights["a"].abs()).clamp(min=2.0**-25)).all()  # half a unit of the last place
        assert error.any()
        assert found["masks"] is weights["masks"]
        assert found["steps"] is weights["steps"]
        assert torch.equal(halved(found, {"a"})["a"], found["a"])

    def test_exception_beyond_the_range(self):
        with pytest.raises(ValueError, match=r"gain is beyond the range of float16, 65504: 70000"):
            halved({"gain": torch.tensor([1.0, -70000.0])}, {"gain"})
