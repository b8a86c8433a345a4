"""The paper's experiments that train a network: they run, resume, repeat, and compare what they say they compare."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace

import pytest
import torch

from examples.paper import discretisation, initialisation, state_of_the_art, transfer
from examples.paper.cameras import F_NUMBER, REFERENCE, camera_with, flat_lens, pinhole, sensor_at
from examples.paper.closed_forms import depth_limit
from examples.paper.report import mean_and_error
from examples.paper.runner import main, read_rows, run
from examples.paper.scenes import BUDGETS, ForCamera, painted
from examples.paper.sequence_length import EXPERIMENT, first_masks
from examples.paper.training import closed_form_system, constant_depth, mean_scores, train
from kornia_tidy import FresnelLens, PixelwiseMask, ThinLensCamera
from kornia_tidy.choices import PRETRAINED, REPLACED
from kornia_tidy.optics.published_systems import SYSTEMS
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

    def test_cardinality_each_trial_of_each_scale_is_another(self, name):
        experiment = importlib.import_module(f"examples.paper.{name}").EXPERIMENT
        for scale in BUDGETS:
            trials = [tuple(trial.items()) for trial in experiment.trials(scale)]
            assert len(set(trials)) == len(trials) > 0


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

    def test_feature_a_table_does_not_depend_on_which_trials_came_first(self, tmp_path):
        counted = replace(EXPERIMENT, measure=lambda trial, scale: {"psnr": len(trial["task"])})
        wanted = run(counted, "smoke", tmp_path)
        path = tmp_path / "sequence_length-smoke.csv"
        header, *lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join([header, *lines[:0:-1]]))  # without the first trial, from the last one
        assert run(counted, "smoke", tmp_path) == wanted
        assert path.read_text() == "".join([header, *lines])

    def test_exception_results_of_other_settings_are_not_mixed(self, tmp_path):
        (tmp_path / "sequence_length-smoke.csv").write_text("task,settings\nedof,other\n")
        with pytest.raises(ValueError, match="holds trials of other settings: remove it"):
            run(EXPERIMENT, "smoke", tmp_path)


class TestCameras(BaseTester):
    @pytest.mark.parametrize("f_number", [17.6, 35.2, 50.0])
    def test_feature_equal_exposure_time_gives_light_by_the_square_of_the_f_number(self, f_number):
        white = torch.ones(())
        relative = sensor_at(f_number).std(white).square() / sensor_at(F_NUMBER).std(white).square()
        stops = (f_number / F_NUMBER) ** 2
        assert stops <= float(relative) <= stops**2  # shot noise alone, read noise alone

    def test_feature_noise_in_the_shade_is_that_of_phasecam3d(self):
        assert float(sensor_at(F_NUMBER).std(torch.tensor(0.2))) == pytest.approx(0.01, rel=0.01)

    def test_feature_a_pinhole_keeps_the_image_in_focus_at_every_depth(self):
        optics = pinhole(SMOKE.fidelity)
        optics.sensor = None
        scene = ForCamera(painted(SMOKE, "test", 2), optics.camera)[0]
        with torch.no_grad():
            sharp = optics(scene["image"][None], scene["depth"][None])[0]
        blurred = camera_with(PixelwiseMask(1, initial="flat"), SMOKE.fidelity, sensor=None)
        with torch.no_grad():
            soft = blurred(scene["image"][None], scene["depth"][None])[0]
        assert (sharp - scene["image"]).square().mean() < 0.02 * (soft - scene["image"]).square().mean()

    def test_feature_a_flat_lens_is_in_focus_where_it_was_asked_to_be(self):
        for focus in (0.25, 1.0):
            camera = flat_lens(50.0, focus, SMOKE.fidelity).camera
            place = normalised_inverse_depth(camera, torch.tensor(float(camera.focus_distance)))
            assert float(place) == pytest.approx(focus, abs=1e-5)

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

    def test_feature_a_seed_repeats_a_training_and_another_does_not(self):
        tested = painted(SMOKE, "test", 2)
        scores = [
            mean_scores(train(camera_with(FresnelLens(), SMOKE.fidelity), "edof", SMOKE, seed), tested)
            for seed in (0, 0, 1)
        ]
        assert scores[0] == scores[1] != scores[2]

    def test_feature_without_blur_and_noise_the_closed_form_restores_the_image(self):
        optics = pinhole(SMOKE.fidelity)
        scores = mean_scores(closed_form_system(optics, "edof", SMOKE), painted(SMOKE, "test", 2))
        masks = camera_with(first_masks(5, "edof", 0), SMOKE.fidelity)
        assert scores["psnr"] > mean_scores(closed_form_system(masks, "edof", SMOKE), painted(SMOKE, "test", 2))["psnr"]

    def test_feature_the_constant_depth_has_the_spread_of_the_scenes_as_its_error(self):
        seen, scored = painted(SMOKE, "train", SMOKE.scenes), painted(SMOKE, "test", SMOKE.scored)
        depths = [
            torch.stack([normalised_inverse_depth(REFERENCE, part[i]["depth"]) for i in range(2)])
            for part in (seen, scored)
        ]
        wanted = (depths[1] - depths[0].mean()).square().mean((1, 2, 3)).sqrt().mean()
        assert constant_depth(SMOKE)["painted_rmse"] == pytest.approx(float(wanted), abs=1e-6)

    def test_feature_fisher_masks_tell_more_of_depth_than_noise(self):
        def limit(start: str) -> float:
            heights = initialisation.initial_heights(start, torch.Generator().manual_seed(0))
            return depth_limit(camera_with(PixelwiseMask(initial=heights), SMOKE.fidelity))

        assert limit("3 fishers, 2 noisy") < limit("noise") < 1 / math.sqrt(12)


class TestSystems(BaseTester):
    def test_feature_every_peer_is_a_published_system(self):
        presets = {peer.preset for peer in state_of_the_art.PEERS.values()} - {"flat", "pinhole", ""}
        assert presets <= set(SYSTEMS)

    def test_feature_the_numbers_of_the_paper_are_those_of_systems_in_the_table(self):
        for task, name in state_of_the_art.PAPER:
            assert task in state_of_the_art.PEERS[name].tasks

    def test_feature_only_the_published_discretisation_casts_colours(self):
        masks = discretisation.first_masks(1, "depth", 0)
        published = discretisation.color_cast(discretisation.camera(masks, discretisation.Fidelity.preset("paper")))
        honest = discretisation.color_cast(discretisation.camera(masks, SMOKE.fidelity))
        assert published["cast_ends"] > published["cast_focus"] + 0.05
        assert honest["cast_ends"] == pytest.approx(1.0, abs=1e-4)

    def test_convention_turned_masks_have_flipped_psfs(self):
        masks = discretisation.first_masks(1, "edof", 0)
        published = discretisation.Fidelity.preset("paper")
        turned = discretisation.mounted(masks, published)
        own, other = (
            discretisation.camera(m, SMOKE.fidelity).psf_bank(3, defocus=[5.0]).psfs.detach() for m in (masks, turned)
        )
        self.assert_close(other, own.flip((-2, -1)), atol=1e-6, rtol=1e-3)

    def test_smoke_its_systems_are_shipped(self):
        assert (
            {trial["system"] for trial in transfer.trials("cpu")} == set(transfer.TRAINED) <= {*PRETRAINED, *REPLACED}
        )


def test_feature_a_mean_has_its_standard_error():
    assert mean_and_error([0.1, 0.3]) == "0.2000 ± 0.1000"
    assert mean_and_error([30.0]) == "30.00"
