"""Theorem 1: what its tables say."""

from __future__ import annotations

from examples.paper import sequences, theorem
from tests.base import BaseTester


class TestTheorem(BaseTester):
    def test_feature_the_witness_of_one_mask_is_one_and_of_five_below(self):
        single, five = (theorem.measure({"what": theorem.WITNESS, "masks": k, "target": "-"}, "smoke") for k in "15")
        assert abs(float(single["least"]) - 1) < 1e-5  # unit phasors in float32
        assert abs(float(single["most"]) - 1) < 1e-5
        assert float(five["most"]) < 0.999

    def test_feature_the_masks_of_the_target_miss_nothing(self):
        hidden = sequences.first_phase(5, [10**6])
        wanted = sequences.psfs_of(hidden[0], psi=theorem.DEPTHS["one depth"])
        losses, _ = sequences.losses_and_gradient(hidden, wanted, theorem.DEPTHS["one depth"])
        assert float(losses) < 1e-10 * float(wanted.square().mean())
