from __future__ import annotations

import pytest
import torch

from kornia_tidy.design.tradeoff import costs
from kornia_tidy.design.tradeoff.costs import peak_bytes, seconds
from tests.base import BaseTester

CPU = torch.device("cpu")


class TestSeconds(BaseTester):
    def test_feature_median_and_interquartile_range_leave_out_the_first_run(self, monkeypatch):
        clock = iter([0.0, 100.0, 0.0, 1.0, 0.0, 2.0, 0.0, 4.0, 0.0, 7.0, 0.0, 50.0])
        monkeypatch.setattr(costs.time, "perf_counter", lambda: next(clock))
        monkeypatch.setattr(costs, "LONG", 1e3)
        assert seconds(lambda: None, 5, CPU) == (4.0, 7.0 - 2.0)

    def test_feature_what_takes_long_is_not_repeated(self, monkeypatch):
        clock = iter([0.0, 0.7, 0.0, 0.6, 0.0, 0.2, 0.0, 9.0])
        monkeypatch.setattr(costs.time, "perf_counter", lambda: next(clock))
        monkeypatch.setattr(costs, "LONG", 1.4)
        assert seconds(lambda: None, 5, CPU) == pytest.approx((0.4, 0.2))
        assert seconds(lambda: None, 5, CPU) == (9.0, 0.0)

    def test_exception(self):
        with pytest.raises(ValueError, match="repeats must be 1 or more, got 0"):
            seconds(lambda: None, 0, CPU)
        with pytest.raises(ValueError, match="device must be one of 'cpu', 'cuda', got 'meta'"):
            seconds(lambda: None, 1, torch.device("meta"))


class TestPeakBytes(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_counts_what_is_held_at_one_time(self):
        def one_after_the_other():
            for _ in range(10):
                torch.empty(2**20)

        def together():
            return [torch.empty(2**20) for _ in range(10)]

        assert peak_bytes(one_after_the_other, CPU) // 2**20 == 4
        assert peak_bytes(together, CPU) // 2**20 == 40

    def test_feature_sees_temporaries_inside_an_operator_and_the_backward_pass(self):
        x = torch.ones(2**18, requires_grad=True)
        forward = peak_bytes(lambda: x.detach().exp().sum(), CPU)
        backward = peak_bytes(lambda: torch.autograd.grad(x.exp().sum(), x), CPU)
        assert forward // 2**20 == 1
        assert backward // 2**20 >= 2
