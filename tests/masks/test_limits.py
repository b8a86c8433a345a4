from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.masks.limits import CONSTRAINTS, limited_phase, unlimited_phase
from tests.base import BaseTester

LIMITS = [c for c in CONSTRAINTS if c != "none"]


class TestLimitedPhase(BaseTester):
    @pytest.mark.parametrize("constraint", LIMITS)
    @given(free=st.floats(-1e3, 1e3, width=32), limit=st.floats(0.1, 50))
    def test_property_never_beyond_the_limits(self, constraint, free, limit):
        shown = limited_phase(torch.tensor(free), constraint, limit)
        assert 0 <= float(shown) <= limit * (1 + 1e-6)

    @pytest.mark.parametrize("constraint", LIMITS)
    @given(share=st.floats(0.002, 0.998), limit=st.floats(0.1, 50))
    def test_property_what_fits_comes_back(self, constraint, share, limit):
        phase = torch.tensor(share * limit, dtype=torch.float64)
        back = limited_phase(unlimited_phase(phase, constraint, limit), constraint, limit)
        assert float(back) == pytest.approx(float(phase), rel=1e-9)

    def test_feature_none_is_the_very_tensor(self):
        free = torch.randn(3)
        assert limited_phase(free, "none", 1.0) is free

    @pytest.mark.parametrize("constraint", LIMITS)
    def test_feature_gradient_is_one_in_the_middle(self, constraint):
        """With a gradient of 1, a learning rate in metres means the same for every constraint."""
        middle = unlimited_phase(torch.tensor(3.0), constraint, 6.0).requires_grad_()
        limited_phase(middle, constraint, 6.0).backward()
        assert float(middle.grad) == pytest.approx(1.0)

    def test_feature_a_clamped_phase_finds_back(self):
        """Beyond a limit plain clamping has no gradient; here one that leads back into the range passes."""
        free = torch.tensor([-9.0, -9.0, 9.0, 9.0, 1.0], requires_grad=True)
        limited_phase(free, "clamp", 6.0).backward(torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0]))
        self.assert_close(free.grad, torch.tensor([0.0, -1.0, 1.0, 0.0, 2.0]))

    def test_feature_clamp_goes_through_vmap(self):
        free = torch.randn(4, 5)
        mapped = torch.vmap(lambda x: limited_phase(x, "clamp", 2.0))(free)
        self.assert_close(mapped, (free + 1).clamp(0, 2))

    @pytest.mark.parametrize("constraint", CONSTRAINTS)
    def test_gradcheck(self, constraint):
        self.gradcheck(lambda x: limited_phase(x, constraint, 6.0), (torch.tensor([-2.5, -1.0, 0.7, 2.9]),))
