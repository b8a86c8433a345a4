"""The paper's experiments that train a network: they run, resume, repeat, and compare what they say they compare."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace

import pytest
import torch

from examples.paper.cameras import REFERENCE, camera_with, flat_lens
from examples.paper.runner import main, read_rows, run
from examples.paper.scenes import BUDGETS, ForCamera, painted
from examples.paper.sequence_length import EXPERIMENT, first_masks
from examples.paper.training import train
from kornia_tidy import ThinLensCamera
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")
SMOKE = BUDGETS["smoke"]
NAMES = (
    "point_psf", "sequence_length", "initialisation", "state_of_the_art", "transfer", "discretisation",
    "switching_training", "boundaries_training",
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")
@pytest.mark.parametrize("name", NAMES)
class TestEveryExperiment(BaseTester):
    @pytest.mark.slow  # .ci/run runs it
    def test_smoke_it_runs_and_says_what_it_can_and_cannot_judge(self, name, tmp_path, capsys):
        experiment = importlib.import_module(f"examples.paper.{name}").EXPERIMENT
        rows = main(experiment, "", ["--threads", "0", "--output", str(tmp_path)])
        assert len(rows) == len(experiment.trials("smoke"))
        for row in rows:
            assert all(math.isfinite(float(value)) for key, value in row.items() if key.endswith(("psnr", "rmse")))
        text = (tmp_path / f"{name}-smoke.md").read_text(encoding="utf-8")
        assert text.startswith(f"## {experiment.title}\n")
        assert "Judged can be" in " ".join(text.split())
        assert "Not judged can be" in " ".join(text.split())
        assert f"{len(rows)} of {len(rows)} trials" in text
        assert (tmp_path / f"{name}-smoke.png").exists() == (experiment.draw is not None)

    def test_smoke_help_teaches(self, name, capsys):
        module = importlib.import_module(f"examples.paper.{name}")
        with pytest.raises(SystemExit) as leaving:
            main(module.EXPERIMENT, module.__doc__, ["--help"])
        assert leaving.value.code == 0
        assert f"python -m examples.paper.{name} --scale cpu" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")
class TestRunner(BaseTester):
    def test_feature_a_stopped_run_goes_on_and_ends_with_the_same_numbers(self, tmp_path):
        measured = []

        def measure(trial, scale):
            measured.append(trial)
            return {"psnr": len(trial["task"]) / 7 + int(trial["masks"])}

        counted = replace(EXPERIMENT, measure=measure)
        count = len(EXPERIMENT.trials("smoke"))
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        for folder in (whole, parts):
            folder.mkdir()
        wanted = run(counted, "smoke", whole)
        assert len(run(counted, "smoke", parts, most=2)) == 2
        assert run(counted, "smoke", parts) == wanted
        assert read_rows(parts / "sequence_length-smoke.csv") == wanted
        assert len(measured) == 2 * count

    def test_exception_results_of_other_settings_are_not_mixed(self, tmp_path):
        (tmp_path / "sequence_length-smoke.csv").write_text("task,settings\nedof,other\n")
        with pytest.raises(ValueError, match="holds trials of other settings: remove it"):
            run(EXPERIMENT, "smoke", tmp_path)


class TestCameras(BaseTester):
    def test_feature_depths_are_stretched_in_dioptres(self):
        near, far = ThinLensCamera.for_scene((1.0, 5.0)), painted(SMOKE, "test", 2)
        scene, stretched = far[0], ForCamera(far, near)[0]
        self.assert_close(
            normalised_inverse_depth(near, stretched["depth"]),
            normalised_inverse_depth(REFERENCE, scene["depth"]),
            atol=1e-5,
            rtol=0.0,
        )
        assert 1.0 - 1e-5 <= float(stretched["depth"].min()) <= float(stretched["depth"].max()) <= 5.0 + 1e-4


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")
class TestTraining(BaseTester):
    def test_feature_masks_are_learnt_and_a_fixed_lens_is_not(self):
        for optics in (camera_with(first_masks(2, "edof", 0), SMOKE.fidelity), flat_lens(50.0, 0.5, SMOKE.fidelity)):
            before = optics.masks.phase.detach().clone()
            system = train(optics, "edof", SMOKE, 0)
            changed = not torch.equal(system.optics.masks.phase.detach(), before)
            assert changed == optics.masks.phase.requires_grad
