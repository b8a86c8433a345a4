"""Tests of the benchmark of results: halves, noise, search, choice on half A, and a short run."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
import torch
from scipy import stats

from tests.base import BaseTester
from tests.benchmarks.results import __main__ as command
from tests.benchmarks.results.measure import NO_CAMERA, search
from tests.benchmarks.results.scenes import BenchScene, SceneSet
from tests.benchmarks.results.scores import depth_scores, local_contrast
from tests.benchmarks.results.store import Cell, Measured, Provenance, Store, SystemRow
from tests.benchmarks.results.table import Key, Results, paired
from tests.benchmarks.results.verdicts import FIVE, REAL
from tests.scenes import halves

HERE = Provenance("2026-11-22", "0000000", "a test")
FLAT, TIKHONOV = "flat f/50", "Tikhonov"


def synthetic(scores: dict[tuple[str, str, str], dict[str, dict[str, float]]], sets: list[SceneSet]) -> Results:
    """Results of made-up scores by noise, system and restoration, then scene; settings follow a colon."""
    cells = [
        Measured(Cell(sets[0].name, scene, system, "", noise, *(restoration + ":").split(":")[:2]), values, HERE)
        for (noise, system, restoration), by_scene in scores.items()
        for scene, values in by_scene.items()
    ]
    names = {key[1] for key in scores}
    systems = {name: SystemRow(name, "", "flat" if "flat" in name else "coded", name, 17.6) for name in names}
    return Results(cells, systems, sets)


def real_like(count: int = 7) -> SceneSet:
    """Names in the halves of the real scenes, without pictures."""
    return SceneSet(REAL, *halves(f"s{number}" for number in range(count)), load=lambda _: pytest.fail("not needed"))


def scored(scenes: SceneSet, value: float, spread: float = 0.0) -> dict[str, dict[str, float]]:
    return {
        name: {"psnr": value + spread * (-1) ** number, "ssim": value / 40, "chroma": value + 8}
        for number, name in enumerate(scenes.names)
    }


class TestHalves(BaseTester):
    def test_feature_the_rule_is_fixed(self):
        names = [f"s{number:02d}" for number in range(35)]
        first, second = halves(reversed(names))
        order = torch.randperm(35, generator=torch.Generator().manual_seed(0)).tolist()
        assert (len(first), len(second)) == (18, 17)
        assert first == sorted(names[index] for index in order[:18])
        assert sorted(first + second) == names


GRID = {"a": tuple(2.0**power for power in range(9)), "b": (1.0, 3.0, 9.0)}


class TestSearch(BaseTester):
    def test_feature_finds_the_best_settings_of_a_tilted_hill(self):
        asked = []

        def value(settings):
            asked.append(tuple(settings.values()))
            a, b = math.log2(settings["a"]), math.log(settings["b"], 3)
            return -((a - 6) ** 2) - 2 * (b - 2) ** 2 + (a - 6) * (b - 2)

        assert search(value, GRID, {"a": 1.5, "b": 1.0}) == {"a": 64.0, "b": 9.0}
        assert len(asked) == len(set(asked)) < len(GRID["a"]) * len(GRID["b"])


class TestScores(BaseTester):
    @staticmethod
    def scene(depth, image=None, known=None):
        image = torch.rand(1, 3, *depth.shape[-2:]) if image is None else image
        known = torch.ones_like(depth, dtype=torch.bool) if known is None else known
        return BenchScene("made", image, depth, known)

    def test_feature_textured_and_textureless_pixels_apart(self):
        image = torch.full((1, 3, 40, 40), 0.5)
        image[..., 20:] += 0.2 * (torch.arange(20) % 2)  # the right half has stripes
        depth, known = torch.zeros(1, 1, 40, 40), torch.ones(1, 1, 40, 40, dtype=torch.bool)
        estimate = depth + 0.1
        estimate[..., 20:] = 0.3
        estimate[..., :4, :], known[..., :4, :] = 9.0, False
        scores = depth_scores(self.scene(depth, image, known), estimate)
        blank = (local_contrast(image) < 0.01)[0, 0, 4:].double().mean().item()
        assert scores["depth_bias_textureless"] == pytest.approx(0.1)
        assert scores["depth_textureless"] == pytest.approx(0.1)
        assert 0.25 < scores["depth_textured"] < 0.3
        whole = blank * scores["depth_textureless"] ** 2 + (1 - blank) * scores["depth_textured"] ** 2
        assert scores["depth"] == pytest.approx(math.sqrt(whole))


class TestPaired(BaseTester):
    def test_feature_mean_and_standard_error_of_the_differences(self):
        ours, theirs = (dict(zip("abcdef", torch.rand(6).double().tolist(), strict=True)) for _ in range(2))
        found, differences = paired(ours, theirs), [ours[name] - theirs[name] for name in ours]
        assert found.mean == pytest.approx(np.mean(differences))
        assert found.error == pytest.approx(stats.sem(differences))
        assert (found.ahead, found.pairs) == (sum(value > 0 for value in differences), 6)


class TestResults(BaseTester):
    def test_feature_half_a_chooses_and_half_b_scores(self):
        scenes = real_like()
        on_a = {name: name in scenes.half_a for name in scenes.names}
        strong, weak = (
            {name: {"psnr": 30.0 if (of_a == best) else 20.0, "ssim": 0.9} for name, of_a in on_a.items()}
            for best in (True, False)
        )
        key = ("0.01", FIVE, TIKHONOV)
        results = synthetic(
            {(*key[:2], f"{TIKHONOV}:weight 1"): strong, (*key[:2], f"{TIKHONOV}:weight 2"): weak}, [scenes]
        )
        row = Key(REAL, *key)
        assert results.settings[row] == "weight 1"
        assert results.mean(row, "psnr") == 20.0
        assert results.mean(row, "psnr", "A") == 30.0

    def test_feature_rows_that_are_not_complete_are_left_out(self):
        scenes = real_like()
        whole, candidates = scored(scenes, 30.0), {name: {"psnr": 31.0} for name in scenes.half_a}
        missing = {name: values for name, values in scored(scenes, 30.0).items() if name != scenes.half_b[0]}
        scores = {("0.01", FIVE, "capture"): whole, ("0.01", FIVE, TIKHONOV): missing}
        assert {key.restoration for key in synthetic(scores, [scenes]).rows} == {"capture"}
        scores[("0.01", FIVE, "capture:weight 2")] = candidates  # better on half A, not scored yet
        assert not synthetic(scores, [scenes]).rows


class TestStore(BaseTester):
    CELL = Cell("real", "a", "flat", "00ff", "0.01", "capture", "")

    def test_feature_cells_outlive_the_process(self, tmp_path):
        with Store(tmp_path / "s.sqlite", HERE) as store:
            store.put_system(SystemRow("flat", "00ff", "flat", "a lens", 50.0))
            store.put(self.CELL, {"psnr": 20.5, "depth": math.nan})
        with Store(tmp_path / "s.sqlite", HERE._replace(day="2026-11-23")) as store:
            (found,) = store.cells()
            assert store.get(self.CELL)["psnr"] == 20.5
            assert store.get(self.CELL._replace(noise="0.002")) == {}
        assert (found.cell, found.provenance) == (self.CELL, HERE)


class TestCommand(BaseTester):
    @pytest.mark.takes_seconds
    def test_smoke_quick_writes_page_table_and_picture(self, tmp_path):
        command.main([str(tmp_path), "--quick"])
        text = (tmp_path / "results.md").read_text()
        assert "## Dead leaves, noise 0.002" in text
        for system in command.QUICK_SYSTEMS:
            assert f"| `{system}` |" in text
        with (tmp_path / "results.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert {row["half"] for row in rows} == {"A", "B"}
        assert all(10 < float(row["psnr"]) < 60 for row in rows if row["system"] != NO_CAMERA)
        assert (tmp_path / "images" / "results.png").read_bytes().startswith(b"\x89PNG")

    @pytest.mark.parametrize(
        ("arguments", "match"),
        [
            (["--systems", "flat f/1"], "there is no system 'flat f/1': choose among joint-uncertain"),
            (["--quick", "--report"], "holds no complete results yet"),
        ],
    )
    def test_exception_one_sentence(self, arguments, match, tmp_path):
        with pytest.raises(SystemExit, match=match):
            command.main([str(tmp_path), *arguments])
