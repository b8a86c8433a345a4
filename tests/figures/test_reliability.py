from __future__ import annotations

import pytest
import torch

from kornia_tidy.figures.reliability import Reliability, draw_reliability
from kornia_tidy.reconstruction.reliability import ReliabilityCurve
from tests.base import BaseTester

CURVE = ReliabilityCurve(torch.tensor([0.05, 0.1, 0.2]), torch.tensor([0.05, 0.15, 0.2]))
ESTIMATE = Reliability(CURVE, (0.5, 1.0), torch.tensor([0.06, 0.14]))


class TestDrawReliability(BaseTester):
    def test_feature_found_over_predicted_and_errors_over_the_surest_pixels(self):
        reliable, surest = draw_reliability({"raw": ESTIMATE, "fitted": ESTIMATE}).axes
        assert len(reliable.lines) == 3  # with the diagonal
        for line in reliable.lines[1:]:
            assert line.get_xdata() == pytest.approx(CURVE.predicted.numpy())
            assert line.get_ydata() == pytest.approx(CURVE.found.numpy())
        assert list(surest.lines[0].get_xdata()) == [50, 100]
        assert surest.lines[0].get_ydata() == pytest.approx(ESTIMATE.errors.numpy())
        assert reliable.get_legend().get_texts()[0].get_text() == "raw: off by 17%"
        assert all(curve.get_xlim()[0] == curve.get_ylim()[0] == 0 for curve in (reliable, surest))

    @pytest.mark.parametrize("count", [0, 5])
    def test_exception_number_of_estimates(self, count):
        with pytest.raises(ValueError, match=f"the picture shows 1 to 4 estimates, got {count}"):
            draw_reliability({str(i): ESTIMATE for i in range(count)})
