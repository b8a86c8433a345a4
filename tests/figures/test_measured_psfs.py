from __future__ import annotations

import pytest
import torch

from kornia_tidy.figures.measured_psfs import draw_measured
from kornia_tidy.lab.calibration.psf import MaskFit, MeasuredPSFs, PointReport
from kornia_tidy.psf import PSFBank, PSFModel
from tests.base import BaseTester


class TestDrawMeasured(BaseTester):
    @pytest.mark.parametrize(("channels", "fitted"), [(1, True), (4, False)])
    def test_feature_every_row_is_drawn_and_savable(self, channels, fitted, tmp_path):
        bank = PSFBank.from_measured(torch.rand(3, channels, 9, 9), torch.tensor([-5.0, 0.0, 5.0]))
        report = PointReport(1.0, 40.2, 40.3, 1.0, 1.1, None)
        measured = MeasuredPSFs(
            bank, 0.01 * torch.rand(3, channels, 9, 9), torch.tensor([2.0, 1.0, 0.5]), (report,) * 6
        )
        fit = (
            MaskFit(PSFModel(), 0.0, torch.zeros(3, 2), bank.psfs, torch.full((3, channels), 0.02)) if fitted else None
        )
        figure = draw_measured(measured, fit)
        assert sum(bool(axes.get_images()) for axes in figure.findobj(lambda x: hasattr(x, "get_images"))) == (
            13 if fitted else 6
        )
        assert "2 m" in figure.findobj(lambda x: hasattr(x, "get_images"))[0].get_title()
        figure.savefig(tmp_path / "measured.png", dpi=40)
