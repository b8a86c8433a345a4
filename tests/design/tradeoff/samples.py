"""Rows and conditions made up for tests: no measuring."""

from __future__ import annotations

from dataclasses import replace

from kornia_tidy import Fidelity
from kornia_tidy.design.tradeoff import TOLERANCES, Conditions, TradeRow, TradeRun, sweep_settings

ROW = TradeRow(
    knob="preset",
    value="balanced",
    fidelity=Fidelity(),
    layers=21,
    window=61,
    rmse=1e-3,
    max_error=2e-2,
    capture_seconds=0.25,
    capture_spread=0.01,
    render_seconds=0.2,
    render_spread=0.004,
    training_seconds=None,
    training_spread=None,
    capture_bytes=3 * 2**20,
    training_bytes=None,
    repeats=5,
)

CONDITIONS = Conditions(
    scene="dead leaves, seed 0",
    height=512,
    width=640,
    channels=3,
    masks=5,
    compositing="gather",
    reference="reference",
    version="0.1.0",
    torch="2.13.0",
    device="a machine",
    threads=2,
    date="2026-01-02T03:04:05+00:00",
)


def whole_sweep() -> TradeRun:
    """Every setting of a sweep, with numbers that spread over the plane as real ones do; the reference has no error."""
    rows = [
        replace(
            ROW,
            **setting._asdict(),
            rmse=0.0 if setting.value == "reference" else 10 ** (-1 - (7 * i % 11) / 4),
            capture_seconds=0.05 * 1.2 ** (5 * i % 17),
            window=setting.value if setting.knob == "window" and setting.value else 61,
        )
        for i, setting in enumerate(sweep_settings())
    ]
    rows += [
        replace(ROW, knob="plan", value=tolerance, rmse=0.6 * tolerance, capture_seconds=0.02 * 4**i)
        for i, tolerance in enumerate(TOLERANCES)
    ]
    return TradeRun(CONDITIONS, tuple(rows))
