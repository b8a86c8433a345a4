from __future__ import annotations

import csv

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy import DwellTimes, Switching
from kornia_tidy.lab.mask_export.timing import frame_times, timing_sheet
from tests.base import BaseTester


class TestFrameTimes(BaseTester):
    def test_exception(self):
        with pytest.raises(ValueError, match="2 transitions of 60 ms must fit into the exposure of 100 ms"):
            frame_times((1, 1, 1), 0.1, 0.06)
        with pytest.raises(ValueError, match="dwell shares must be finite, not negative and not all zero"):
            frame_times((0, 0), 0.1)
        with pytest.raises(ValueError, match="exposure must be positive"):
            frame_times((1,), 0.0)

    @given(st.lists(st.floats(0.1, 9), min_size=1, max_size=7), st.floats(1e-3, 2), st.floats(0, 0.99), st.booleans())
    def test_feature_the_exposure_is_filled_without_a_gap(self, shares, exposure, full, cyclic):
        swaps = len(shares) if cyclic and len(shares) > 1 else len(shares) - 1
        lines = frame_times(shares, exposure, full * exposure / max(swaps, 1), cyclic)
        end = 0.0
        for line in lines:
            assert line.start == pytest.approx(end, abs=1e-12)
            end = line.start + line.dwell + line.swap
        assert end == pytest.approx(exposure, rel=1e-9)
        ratio = lines[0].dwell / lines[-1].dwell
        assert ratio == pytest.approx(shares[0] / shares[-1], rel=1e-9)

    @pytest.mark.parametrize("cyclic", [False, True])
    def test_feature_weights_are_those_of_the_simulated_exposure(self, cyclic):
        shares = (1.0, 3.0, 2.0)
        weights = Switching(7e-3, 0.08, dwell=DwellTimes(shares), cyclic=cyclic)(torch.zeros(3, 5, 5).double())[1]
        lines = frame_times(shares, 0.08, 7e-3, cyclic)
        assert [line.weight for line in lines] == pytest.approx(weights[:3].tolist(), rel=1e-12)
        assert sum(line.swap for line in lines) / 0.08 == pytest.approx(float(weights[3:].sum()))

    def test_feature_the_sheet_is_csv_in_milliseconds(self):
        rows = list(
            csv.DictReader(timing_sheet(frame_times((1, 3), 0.1, 0.02), ["a.png", "b.png"]).decode().splitlines())
        )
        assert rows[1] == {
            "frame": "1",
            "file": "b.png",
            "start_ms": "40.000000",
            "dwell_ms": "60.000000",
            "weight": "0.600000000",
            "swap_ms": "0.000000",
        }
        assert (rows[0]["dwell_ms"], rows[0]["swap_ms"]) == ("20.000000", "20.000000")
