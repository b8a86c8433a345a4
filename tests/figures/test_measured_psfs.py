from __future__ import annotations

import pytest
import torch

from kornia_tidy import PSFBank
from kornia_tidy.figures.measured_psfs import draw_measured
from kornia_tidy.lab.calibration.psf import MeasuredPSFs, PointReport
from tests.base import BaseTester


class TestDrawMeasured(BaseTester):
    @pytest.mark.parametrize("channels", [1, 4])
    def test_feature_every_row_is_drawn_and_savable(self, channels, tmp_path):
        bank = PSFBank.from_measured(torch.rand(3, channels, 9, 9), torch.tensor([-5.0, 0.0, 5.0]))
        report = PointReport(1.0, 40.2, 40.3, 1.0, 1.1, None)
        measured = MeasuredPSFs(
            bank, 0.01 * torch.rand(3, channels, 9, 9), torch.tensor([2.0, 1.0, 0.5]), (report,) * 6
        )
        figure = draw_measured(measured)
        assert sum(bool(axes.get_images()) for axes in figure.findobj(lambda x: hasattr(x, "get_images"))) == 6
        assert "2 m" in figure.findobj(lambda x: hasattr(x, "get_images"))[0].get_title()
        figure.savefig(tmp_path / "measured.png", dpi=40)
