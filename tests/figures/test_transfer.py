from __future__ import annotations

from dataclasses import replace

import pytest

from kornia_tidy.figures.transfer import draw_transfer
from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer, TransferLine
from kornia_tidy.lab.calibration.noise.transfer_curve import CurvePoint
from tests.base import BaseTester

LINE = TransferLine(2.0, 0.01, 6.0, 0.1, 0.01, 0.999, 10000)
POINTS = tuple(CurvePoint(name, m, m / 2 + 9.1, 1000) for name in "RG" for m in (0.0, 10.0, 500.0))
RESULT = PhotonTransfer("Acme One", 100.0, "single", 512.0, 4095.0, LINE, {"R": LINE}, POINTS)


class TestDrawTransfer(BaseTester):
    def test_feature_all_points_and_the_line_are_drawn(self):
        (axes,) = draw_transfer(RESULT).axes
        lines = {line.get_label(): line for line in axes.lines}
        for name in "RG":
            lit = [point for point in POINTS if point.level and point.channel == name]
            levels, noises = lines[name].get_data()
            assert levels == pytest.approx([2 * point.level for point in lit])
            assert noises == pytest.approx([2 * point.variance**0.5 for point in lit])
        electrons, noise = lines["together"].get_data()
        counts = electrons / 2
        assert noise**2 / 4 == pytest.approx(counts / 2 + 9 + 1 / 12 + (0.01 * counts) ** 2)
        assert lines["fixed pattern"].get_data()[1] == pytest.approx(0.01 * electrons)
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")

    def test_feature_says_the_numbers(self):
        figure = draw_transfer(RESULT)
        words = figure.get_suptitle() + figure.axes[0].get_title()
        for word in ("Acme One, ISO 100", "gain 2 ± 0.01", "read 6 ± 0.1", "R² 0.9990"):
            assert word in words

    def test_exception_no_points(self):
        with pytest.raises(ValueError, match="the calibration has no points"):
            draw_transfer(replace(RESULT, points=()))
