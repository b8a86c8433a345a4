"""Theorem 1: what its tables say."""

from __future__ import annotations

from examples.paper import sequences, theorem
from examples.paper.runner import run
from tests.base import BaseTester


class TestTheorem(BaseTester):
    def test_smoke_witnesses_and_reach(self, tmp_path):
        rows = run(theorem.EXPERIMENT, "smoke", tmp_path)
        single = next(row for row in rows if row["what"] == theorem.WITNESS and row["masks"] == "1")
        assert abs(float(single["least"]) - 1) < 1e-5  # unit phasors in float32
        assert abs(float(single["most"]) - 1) < 1e-5
        assert float(next(row for row in rows if row["masks"] == "5")["most"]) < 0.999
        assert "| 16 |" in theorem.table(rows, "smoke")
        theorem.draw(rows, tmp_path / "figure.png")
        assert (tmp_path / "figure.png").stat().st_size > 1e4

    def test_feature_the_masks_of_the_target_miss_nothing(self):
        hidden = sequences.first_phase(5, [10**6])
        wanted = sequences.psfs_of(hidden[0], psi=theorem.DEPTHS["one depth"])
        losses, _ = sequences.losses_and_gradient(hidden, wanted, theorem.DEPTHS["one depth"])
        assert float(losses) < 1e-10 * float(wanted.square().mean())
