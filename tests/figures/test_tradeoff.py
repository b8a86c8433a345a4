from __future__ import annotations

from dataclasses import replace

import pytest

from kornia_tidy.design.tradeoff import SWEEP_VALUES, TradeRun, pareto
from kornia_tidy.figures.tradeoff import draw_trade
from tests.base import BaseTester
from tests.design.tradeoff.samples import CONDITIONS, ROW, whole_sweep


def labels(figure):
    """Return what stands beside the points."""
    return {text.get_text() for text in figure.axes[0].texts}


class TestDrawTrade(BaseTester):
    def test_feature_each_knob_has_a_line_through_all_its_rows(self):
        run = whole_sweep()
        axes = draw_trade(run).axes[0]
        lines = {line.get_label().split(",")[0]: line for line in axes.lines}
        for knob in SWEEP_VALUES:
            if knob != "preset":
                expected = sorted(1e3 * row.capture_seconds for row in run.rows if row.knob == knob)
                assert sorted(lines[knob].get_xdata()) == pytest.approx(expected)
        stars = axes.collections[0].get_offsets()
        assert len(stars) == sum(row.knob == "preset" for row in run.rows)

    def test_feature_plans_have_a_line_with_the_tolerances_asked(self):
        run = whole_sweep()
        figure = draw_trade(run)
        (line,) = [line for line in figure.axes[0].lines if line.get_label() == "plan, by tolerance"]
        plans = [row for row in run.rows if row.knob == "plan"]
        assert sorted(line.get_ydata()) == sorted(row.rmse for row in plans)
        assert {"1e-1", "1e-3", "1e-6"} <= labels(figure)

    def test_feature_the_front_runs_through_its_rows(self):
        run = whole_sweep()
        (front,) = [line for line in draw_trade(run).axes[0].lines if line.get_label() == "Pareto front"]
        drawn = set(zip(front.get_xdata(), front.get_ydata(), strict=True))
        assert {(1e3 * row.capture_seconds, row.rmse) for row in pareto(run.rows) if row.rmse} <= drawn

    def test_feature_presets_are_named(self):
        assert {"paper", "draft", "balanced", "reference"} <= labels(draw_trade(whole_sweep()))

    def test_feature_no_error_is_drawn_below_the_smallest(self):
        axes = draw_trade(whole_sweep()).axes[0]
        smallest = min(row.rmse for row in whole_sweep().rows if row.rmse)
        assert axes.collections[0].get_offsets()[:, 1].min() < smallest / 2
        assert any(text.startswith("no error: this is 'reference'") for text in labels(axes.figure))

    @pytest.mark.parametrize("rmse", [0.0, 1e-3])
    def test_cardinality_one_row(self, rmse, tmp_path):
        draw_trade(TradeRun(CONDITIONS, (replace(ROW, rmse=rmse),))).savefig(tmp_path / "trade.png", dpi=50)
        assert (tmp_path / "trade.png").stat().st_size > 1000

    def test_exception_nothing_to_draw(self):
        with pytest.raises(ValueError, match="the sweep has no rows"):
            draw_trade(TradeRun(CONDITIONS, ()))
