"""All in focus without a network: its gradient against the library's, its batches, and its table."""

from __future__ import annotations

import pytest
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

    def test_feature_a_start_learns_alike_alone_and_among_others(self):
        """Up to the rounding of transforms of other batches, which 15 steps of Adam may carry on."""
        alone = sequences.learn(sequences.first_phase(2, [1]), 15, sequences.impulse())
        among = sequences.learn(sequences.first_phase(2, [0, 1, 2]), 15, sequences.impulse())
        assert float(among.after[1]) == pytest.approx(float(alone.after[0]), rel=1e-4)
        assert (among.after < among.before).all()

    def test_feature_a_start_that_has_converged_is_left_alone(self, monkeypatch):
        monkeypatch.setattr(sequences, "PATIENCE", 2)
        monkeypatch.setattr(sequences, "LEAST_GAIN", 0.5)  # no step gains so much
        learnt = sequences.learn(sequences.first_phase(1, [0, 1]), 200, sequences.impulse())
        assert learnt.steps.tolist() == [11, 11]  # the first gains; then two for each of five halvings

    def test_feature_the_capture_of_a_point_is_the_scene(self):
        point = sequences.impulse().expand(21, -1, -1)
        assert point_psf.capture_error(point) < 1e-6
        assert point_psf.capture_error(0.5 * point) == pytest.approx(
            0.5 * float(point_psf.scenes()[0][..., 11:-11, 11:-11].square().mean().sqrt()), rel=1e-4
        )
        assert point_psf.capture_error(0.5 * point, scaled=True) < 1e-6
