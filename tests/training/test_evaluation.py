"""Scores of a scene, against their definitions written out in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from kornia_tidy import DefocusRange, FresnelLens, ThinLensCamera, TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from kornia_tidy.reconstruction.trained import TrainedSystem
from kornia_tidy.training.evaluation import SceneResult, depth_row, evaluate, image_row, mean_row, table
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester

INF = float("inf")


def result(camera, depth, estimate, mask=None):
    depth = torch.tensor(depth).view(1, 1, -1)
    maps = {"depth": torch.tensor(estimate).view(1, 1, -1)}
    mask = torch.ones_like(depth, dtype=torch.bool) if mask is None else torch.tensor(mask).view(1, 1, -1)
    return SceneResult(0, "a", depth, maps, {"depth": normalised_inverse_depth(camera, depth)}, depth, mask)


class TestDepthRow(BaseTester):
    def test_feature_scores_are_their_definitions(self):
        """From 0.3 m to infinity inverse_depth is 0.3 / z: by hand, without the camera."""
        camera = ThinLensCamera.for_scene((0.3, INF))
        depth, guess = np.array([0.3, 0.5, 1.0, 2.0, 9.0]), np.array([0.9, 0.5, 0.4, 0.1, 0.05])
        row = depth_row(camera, result(camera, depth, guess))
        away = guess - 0.3 / depth
        assert row["depth_rmse"] == pytest.approx(math.sqrt((away**2).mean()), rel=1e-5)
        assert row["depth_rmse_radians"] == pytest.approx(40 * math.sqrt((away**2).mean()), rel=1e-5)
        found = 0.3 / guess
        assert row["depth_rmse_metres"] == pytest.approx(math.sqrt(((found - depth) ** 2).mean()), rel=1e-5)
        assert row["depth_abs_rel"] == pytest.approx((abs(found - depth) / depth).mean(), rel=1e-5)
        assert row["depth_log10"] == pytest.approx(abs(np.log10(found / depth)).mean(), rel=1e-5)
        ratio = np.maximum(found / depth, depth / found)
        for n in (1, 2, 3):
            assert row[f"depth_delta{n}"] == pytest.approx((ratio < 1.25**n).mean())
        assert row["depth_counted"] == 1

    def test_convention_infinity_counts_as_nearness_and_not_in_metres(self):
        """Beyond 32 near ends and unknown pixels do not count; an estimate of infinity is taken as 32 near ends."""
        camera = ThinLensCamera.for_scene((0.25, INF))
        scene = result(camera, [INF, 9.0, 0.2, 8.0, 0.5], [1.0, 1.0, 1.0, -0.5, 0.5], [True] * 4 + [False])
        row = depth_row(camera, scene)
        assert row["depth_counted"] == pytest.approx(1 / 5)
        assert row["depth_rmse_metres"] == pytest.approx(0, abs=1e-6)
        errors = [1.0, 1 - 0.25 / 9, 0.0, -0.5 - 0.25 / 8]
        assert row["depth_rmse"] == pytest.approx(math.sqrt(np.square(errors).mean()), rel=1e-5)

    def test_feature_a_range_with_a_far_end_counts_to_it(self):
        camera = ThinLensCamera.for_scene((0.5, 1.7))
        row = depth_row(camera, result(camera, [0.5, 1.7, 1.8], [1.0, 0.0, 0.0]))
        assert row["depth_counted"] == pytest.approx(2 / 3)
        assert row["depth_abs_rel"] == pytest.approx(0, abs=1e-6)

    def test_feature_a_told_uncertainty_is_scored(self):
        """Ten pixels: three in ten are left out, the least sure ones, which hold the large errors."""
        deviation = torch.tensor([0.1] * 7 + [0.3] * 3).view(1, 1, -1)
        estimate = [0.6] * 7 + [0.9, 0.0, 1.0]
        scene = result(DefocusRange(), [0.5] * 10, estimate)._replace(deviation=deviation)
        row = depth_row(DefocusRange(), scene)
        assert row["depth_rmse_surest"] == pytest.approx(0.1, rel=1e-5)
        assert row["depth_deviation"] == pytest.approx(math.sqrt(0.7 * 0.1**2 + 0.3 * 0.3**2), rel=1e-5)
        unknown = depth_row(DefocusRange(), scene._replace(mask=torch.zeros_like(scene.mask)))
        assert math.isnan(unknown["depth_rmse_surest"])

    def test_feature_normalised_disparity_has_no_metres(self):
        camera = DefocusRange(-10, 10)
        row = depth_row(camera, result(camera, [0.0, 0.5], [0.1, 0.4]))
        assert row == pytest.approx({"depth_rmse": 0.1, "depth_rmse_radians": 2.0})

    def test_feature_a_scene_without_known_depth_has_no_score(self):
        camera = ThinLensCamera()
        row = depth_row(camera, result(camera, [1.0, 1.0], [0.5, 0.5], [False, False]))
        assert row.pop("depth_counted") == 0
        assert all(math.isnan(value) for value in row.values())


class TestImageRow(BaseTester):
    def test_feature_scores_are_their_definitions(self):
        truth = torch.full((3, 16, 16), 0.5)
        maps = {"image": truth + 0.1}
        row = image_row(SceneResult(0, "a", truth, maps, {"image": truth}, truth[:1], truth[:1] > 0))
        assert row["image_rmse"] == pytest.approx(0.1, rel=1e-5)
        assert row["image_psnr"] == pytest.approx(20, rel=1e-5)
        assert row["image_ssim"] == pytest.approx((2 * 0.5 * 0.6 + 1e-4) / (0.25 + 0.36 + 1e-4), rel=1e-4)


class TestEvaluate(BaseTester):
    @pytest.mark.parametrize("task", ["edof", "depth", "joint"])
    def test_cardinality_a_row_a_scene_with_the_scores_of_the_task(self, task):
        channels = {"edof": 3, "depth": 1, "joint": 4}[task]
        settings = TrainingSettings(task=task, masks=0)
        system = TrainedSystem(TiDyOptics(FresnelLens()).eval(), nn.Conv2d(3, channels, 1), settings, 0)
        rows = evaluate(system, DeadLeaves(2, 40, 40, depth_range=(0.3, INF)))
        assert [(row["scene"], row["name"]) for row in rows] == [(0, "dead leaves 0/0"), (1, "dead leaves 0/1")]
        assert ("image_ssim" in rows[0]) == (task != "depth")
        assert ("depth_abs_rel" in rows[0]) == (task != "edof")

    def test_feature_means_and_ranges_leave_out_what_has_no_score(self):
        rows = [{"scene": i, "name": "a", "depth_rmse": value} for i, value in enumerate((0.25, math.nan, 0.75))]
        assert mean_row(rows) == {"depth_rmse": 0.5}
        assert table(rows)[1].split() == ["depth_rmse", "0.5000", "0.2500", "0.7500"]
