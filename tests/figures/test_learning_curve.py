from __future__ import annotations

import pytest

from kornia_tidy.figures.learning_curve import draw_learning_curve, plateau_step
from tests.base import BaseTester


def write_run(folder, score="val_image_psnr", values=(25.0, 27.0, 27.95, 28.0)):
    lines = [f"0,{step},{1 / step}" for step in range(1, 401)]
    (folder / "training.csv").write_text("\n".join(["epoch,step,loss", *lines]) + "\n")
    lines = [f"{epoch},{100 * epoch + 100},{value}" for epoch, value in enumerate(values)]
    (folder / "validation.csv").write_text("\n".join([f"epoch,step,{score}", *lines]) + "\n")


class TestPlateauStep(BaseTester):
    @pytest.mark.parametrize(
        ("scores", "step"),
        [
            ([1.0], 1),
            ([1.0, 2.0, 3.0], 3),
            ([3.0, 2.0, 3.0], 1),
            ([1.0, 2.95, 3.0], 2),
            ([3.0, 3.0, 3.0], 1),
            ([1.0, 3.0, 2.0], 2),
        ],
    )
    def test_feature_later_scores_gain_no_more_than_the_tolerance(self, scores, step):
        assert plateau_step(list(range(1, len(scores) + 1)), scores) == step

    def test_exception_no_score(self):
        with pytest.raises(ValueError, match="needs a score for each step, got 0 for 1 steps"):
            plateau_step([1], [])


class TestDrawLearningCurve(BaseTester):
    def test_feature_scores_are_drawn_and_the_plateau_is_told(self, tmp_path):
        write_run(tmp_path)
        figure = draw_learning_curve(tmp_path)
        losses, scores = figure.axes
        assert scores.lines[0].get_xydata().tolist() == [[100, 25], [200, 27], [300, 27.95], [400, 28]]
        assert list(scores.lines[1].get_xdata()) == [300, 300]
        steps, means = losses.lines[0].get_data()
        assert (steps[0], means[0]) == (4.5, pytest.approx(sum(1 / n for n in range(1, 9)) / 8))
        assert "best validation PSNR 28.00 dB; within 0.1 dB of it at step 300 of 400" in figure.texts[1].get_text()

    def test_feature_a_loss_in_decibels_is_drawn_too(self, tmp_path):
        write_run(tmp_path)
        log = tmp_path / "training.csv"
        name, *rows = log.read_text().splitlines()
        cells = [row.split(",") for row in rows]
        log.write_text("\n".join([name, *(f"{epoch},{step},-{loss}" for epoch, step, loss in cells)]) + "\n")
        losses, _ = draw_learning_curve(tmp_path).axes
        low, high = losses.get_ylim()
        assert all(low <= mean <= high for mean in losses.lines[0].get_ydata())

    def test_feature_a_curve_that_rises_to_the_end_is_told_so(self, tmp_path):
        write_run(tmp_path, "val_depth_rmse", (0.4, 0.2, 0.1))
        figure = draw_learning_curve(tmp_path)
        assert figure.axes[1].lines[0].get_ydata() == pytest.approx([7.959, 13.979, 20], abs=1e-3)
        assert "still rising at the end" in figure.texts[1].get_text()

    def test_exception_no_logs(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"training.csv: there is no such file"):
            draw_learning_curve(tmp_path)
        write_run(tmp_path, values=())
        with pytest.raises(ValueError, match="has no validated epoch yet"):
            draw_learning_curve(tmp_path)
