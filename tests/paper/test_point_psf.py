"""All in focus without a network: its gradient against the library's, its batches, and its table."""

from __future__ import annotations

import torch

from examples.paper import point_psf, sequences
from examples.paper.runner import ABOUT, run
from tests.base import BaseTester


def scores(row):
    return {name: value for name, value in row.items() if name not in ABOUT}


class TestPointPSF(BaseTester):
    def test_feature_interrupted_and_resumed_gives_the_same_rows(self, tmp_path):
        once, twice = tmp_path / "once", tmp_path / "twice"
        once.mkdir()
        twice.mkdir()
        whole = run(point_psf.EXPERIMENT, "smoke", once)
        assert len(run(point_psf.EXPERIMENT, "smoke", twice, 2)) == 2
        assert [scores(row) for row in run(point_psf.EXPERIMENT, "smoke", twice)] == [scores(row) for row in whole]

    def test_gradcheck_loss_and_gradient_are_those_of_the_library(self):
        """Both sum 529 x 21 squares in float32: 3e-6 of the largest gradient is left for their rounding."""
        phase = sequences.first_phase(3, [0, 1])
        losses, gradient = sequences.losses_and_gradient(phase, sequences.impulse())
        leaf = phase.clone().requires_grad_()
        expected = torch.stack([(sequences.psfs_of(one) - sequences.impulse()).square().mean() for one in leaf])
        (slope,) = torch.autograd.grad(expected.sum(), leaf)
        self.assert_close(losses, expected, rtol=1e-5, atol=0)
        assert (gradient - slope).abs().max() < 3e-6 * slope.abs().max()
