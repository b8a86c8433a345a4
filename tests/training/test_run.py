from __future__ import annotations

import csv
import json
import os
from types import SimpleNamespace

import pytest
import torch

from kornia_tidy.data import DeadLeaves
from kornia_tidy.files import only_here
from kornia_tidy.reconstruction.state_file import read_state
from kornia_tidy.training import data_sets, scenes
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")

from kornia_tidy.training.callbacks import WriteLog
from kornia_tidy.training.module import TidyTraining
from kornia_tidy.training.noise_free import NoiseFreeCaptures
from kornia_tidy.training.run import train

SETTINGS = TrainingSettings(
    task="depth", masks=1, head="plain", width=4, size=32, scenes=4, validation_scenes=1, batch=2, epochs=2, window=9,
    lr=1e-2,
)  # fmt: skip

NETWORK = {"task": "edof", "learn": "network", "crop": 24, "fidelity": "draft", "loss": "charbonnier"}
# Scenes of its seed lie wholly at 80 m and more, where this lens has the focus of infinity.
FAR = SETTINGS.replace(
    **{**NETWORK, "crop": None},
    data="dead-leaves",
    depth_range=(0.3, 100.0),
    f_number=40.0,
    size=16,
    scenes=24,
    epochs=1,
)


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class TestTrain(BaseTester):
    def test_feature_a_run_writes_what_people_open(self, tmp_path):
        train(SETTINGS, tmp_path)
        log = rows(tmp_path / "training.csv")
        assert [row["step"] for row in log] == ["1", "2", "3", "4"]
        scores = rows(tmp_path / "validation.csv")
        assert [row["epoch"] for row in scores] == ["0", "1"]
        best = min(float(row["val_loss"]) for row in scores)
        assert read_state(tmp_path / "last.safetensors")["callbacks"]["SaveCheckpoints"]["best"] == pytest.approx(best)
        assert json.loads((tmp_path / "settings.json").read_text())["window"] == 9
        names = {path.name for path in (tmp_path / "pictures").iterdir()}
        assert {"epoch_0001_masks.png", "epoch_0001_psfs.png", "epoch_0001_estimates.png"} <= names
        assert list((tmp_path / "tensorboard").glob("events.*"))

    def test_feature_the_log_has_the_seconds_of_a_step(self, tmp_path, monkeypatch):
        moments = iter([0.0, 3.0, 3.0, 5.0, 5.0])
        monkeypatch.setattr("kornia_tidy.training.callbacks.time", SimpleNamespace(perf_counter=lambda: next(moments)))
        trainer = SimpleNamespace(global_step=0, is_global_zero=True, current_epoch=0, callback_metrics={"loss": 1.0})
        log = WriteLog(tmp_path, every=2)
        log.on_train_start(trainer, None)
        for trainer.global_step in (2, 4):
            log.on_train_batch_end(trainer)
        assert [row["seconds_a_step"] for row in rows(tmp_path / "training.csv")] == ["1.5", "1.0"]

    def test_exception_a_second_run_in_the_folder_of_one_at_work(self, tmp_path):
        with only_here(tmp_path, "a training is at work"):
            for resume in (False, True):
                with pytest.raises(ValueError, match=r"a training is at work in .* already: wait for it to end"):
                    train(SETTINGS, tmp_path, resume=resume)
            assert os.listdir(tmp_path) == []

    def test_feature_far_painted_scenes_are_not_taken_for_another_unit(self, tmp_path):
        train(FAR, tmp_path)  # a warning would be an error

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize(
        "changes",
        [
            {},
            {"masks": 0},
            {"refocus": 3, "start": "fisher, noise"},
            {"task": "edof", "design": 3, "start": "focal sweep", "window": None, "fidelity": "draft"},
            {**NETWORK, "design": 3, "start": "focal sweep", "window": None},
        ],
    )
    def test_feature_more_epochs_go_on_as_if_asked_for_at_first(self, changes, tmp_path):
        settings = SETTINGS.replace(**changes)
        whole = train(settings, tmp_path / "a").state_dict()
        train(settings.replace(epochs=1), tmp_path / "b")
        parts = train(settings, tmp_path / "b", resume=True).state_dict()
        assert all(torch.equal(whole[name], parts[name]) for name in whole)
        assert rows(tmp_path / "a" / "validation.csv") == rows(tmp_path / "b" / "validation.csv")

    def test_feature_the_network_is_trained_first_behind_a_fixed_lens(self, tmp_path):
        module = train(SETTINGS.replace(pretrain_epochs=1, epochs=1, lr=1e-12, ema=0.5), tmp_path)
        first = read_state(tmp_path / "pretrain" / "last.safetensors")
        assert first["settings"]["masks"] == 0
        assert "optics.masks.phase" in first["state_dict"]  # fixed, and stored
        weights = first["state_dict"]["average.network.layers.0.weight"]
        self.assert_close(module.head.layers[0].weight.detach(), weights, rtol=0, atol=1e-9)

    def test_feature_a_run_begins_with_the_masks_of_another(self, tmp_path):
        first = train(SETTINGS.replace(epochs=1), tmp_path / "a")
        other = SETTINGS.replace(epochs=1, lr_metres=1e-30, sigma=0.003, stray_light="veil", window=11)
        second = train(other, tmp_path / "b", masks_from=tmp_path / "a" / "last.safetensors")
        assert torch.equal(first.optics.masks.phase, second.optics.masks.phase)
        assert second.optics.window == 11
        assert second.optics.fidelity.stray_light == "veil"

    def test_feature_masks_go_on_through_the_network_of_another_run(self, tmp_path):
        both = SETTINGS.replace(task="edof", epochs=1, masks=2)
        first = train(both, tmp_path / "a")
        given = {"head_from": tmp_path / "a" / "last.safetensors", "masks_from": tmp_path / "a" / "last.safetensors"}
        module = train(both.replace(learn="masks"), tmp_path / "b", **given)
        kept = read_state(tmp_path / "b" / "best.safetensors")["state_dict"]
        weights = first.average.network.state_dict()
        assert all(torch.equal(kept[f"head.{name}"], value) for name, value in weights.items())
        assert not torch.equal(module.optics.masks.phase, first.optics.masks.phase)
        assert not (tmp_path / "b" / "captures").exists()
        train(both.replace(learn="masks", epochs=2), tmp_path / "b", resume=True)
        assert len(rows(tmp_path / "b" / "training.csv")) == 4

    def test_exception_masks_alone_need_a_network_that_has_learnt(self, tmp_path):
        with pytest.raises(ValueError, match=r"begin with that of a trained system, head_from, or take a head without"):
            train(SETTINGS.replace(learn="masks"), tmp_path, resume=True)  # there is nothing to resume
        train(SETTINGS.replace(learn="masks", task="edof", head="wiener-bilateral", epochs=1), tmp_path)

    def test_exception_masks_of_another_number_are_refused(self, tmp_path):
        train(SETTINGS.replace(epochs=1), tmp_path / "a")
        with pytest.raises(ValueError, match=r"masks does not fit: .*phase is \(1, 23, 23\)"):
            train(SETTINGS.replace(masks=2), tmp_path / "b", masks_from=tmp_path / "a" / "last.safetensors")

    def test_feature_it_stops_when_nothing_improves_and_stays_stopped(self, tmp_path):
        still = SETTINGS.replace(lr=1e-30, lr_metres=1e-30, ema=0.0, patience=2, epochs=9)
        train(still, tmp_path)
        assert len(rows(tmp_path / "validation.csv")) == 3  # one to set the mark, two without improvement
        train(still, tmp_path, resume=True)
        assert len(rows(tmp_path / "validation.csv")) == 3

    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    @pytest.mark.parametrize("workers", [0, 1])
    def test_exception_a_broken_scene_stops_by_name_and_the_run_goes_on_once_it_is_mended(
        self, workers, tmp_path, monkeypatch
    ):
        class Breaking(DeadLeaves):
            def __getitem__(self, index):
                if broken and index == broken[0]:
                    raise ValueError("cannot read /data/2.png: the file is cut short")
                return super().__getitem__(index)

        make = {TrainingSettings().data: lambda settings, split, count: Breaking(4 if split == "train" else 1, 32, 32)}
        monkeypatch.setattr(data_sets, "SCENES", make)
        order = [index for batch in scenes.EpochBatches(4, 1) for _, index in batch]
        broken = [order[2]]
        settings = SETTINGS.replace(batch=1, epochs=1)
        with pytest.raises(ValueError, match=f"scene {order[2]} of the data cannot be used: cannot read /data/2.png"):
            train(settings, tmp_path / "a", save_every=1, workers=workers)
        assert read_state(tmp_path / "a" / "last.safetensors")["global_step"] == 2
        broken.clear()
        mended = train(settings, tmp_path / "a", resume=True, workers=workers).state_dict()
        whole = train(settings, tmp_path / "b").state_dict()
        assert all(torch.equal(whole[name], mended[name]) for name in whole)

    def test_feature_captures_are_rendered_once_for_all_runs_and_epochs(self, tmp_path, monkeypatch):
        rendered, render = [], NoiseFreeCaptures._render
        monkeypatch.setattr(NoiseFreeCaptures, "_render", lambda c, i: rendered.append(i) or render(c, i))
        settings = SETTINGS.replace(**NETWORK)
        one = train(settings, tmp_path / "a", captures=tmp_path / "captures")
        train(settings.replace(noise_range=(0.01, 0.02)), tmp_path / "b", captures=tmp_path / "captures")
        assert sorted(rendered) == [0, 0, 1, 2, 3]  # four to train on, one to validate with
        before = TidyTraining.from_settings(settings).optics.masks.phase
        assert torch.equal(one.optics.masks.phase, before)
        assert not one.optics.masks.phase.requires_grad
        assert "val_image_psnr" in rows(tmp_path / "a" / "validation.csv")[0]
        with pytest.raises(ValueError, match=r"holds captures made otherwise .*camera.*set of scenes\.data"):
            train(settings.replace(seed=1, data="dead-leaves"), tmp_path / "c", captures=tmp_path / "captures")

    def test_feature_the_network_alone_goes_on_from_within_an_epoch(self, tmp_path, monkeypatch):
        settings = SETTINGS.replace(**NETWORK, epochs=1, scenes=6)
        whole = train(settings, tmp_path / "a").state_dict()
        step, calls = TidyTraining.training_step, iter(range(9))

        def stopping(*args):
            if next(calls) == 2:
                raise RuntimeError("stop")
            return step(*args)

        monkeypatch.setattr(TidyTraining, "training_step", stopping)
        with pytest.raises(RuntimeError, match="stop"):
            train(settings, tmp_path / "b", save_every=1)
        parts = train(settings, tmp_path / "b", resume=True).state_dict()
        assert all(torch.equal(whole[name], parts[name]) for name in whole)

    def test_exception_another_run_is_not_overwritten_nor_mixed_with(self, tmp_path):
        train(SETTINGS.replace(epochs=1), tmp_path)
        with pytest.raises(ValueError, match="holds a run already"):
            train(SETTINGS, tmp_path)
        with pytest.raises(ValueError, match=r"other settings \(stored / asked for\): lr \(0.01 / 0.1\)$"):
            train(SETTINGS.replace(lr=0.1), tmp_path, resume=True)
