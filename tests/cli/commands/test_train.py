from __future__ import annotations

import csv
import json
import subprocess
import sys

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_image
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.settings import NETWORK_RUN, TrainingSettings
from tests.base import BaseTester

pytest.importorskip("lightning.pytorch")

SMALL = ["--masks", "1", "--head", "plain", "--width", "4"]
SMALL += ["--size", "40", "--scenes", "4", "--validation-scenes", "1", "--batch", "2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    options = ["--task", "joint", "--epochs", "1", "--pretrain-epochs", "1", "--lr", "0.001", "--seed", "3"]
    assert main(["train", *SMALL, *options, "-o", str(folder)]) == 0
    return folder


class TestTrain(BaseTester):
    def test_feature_the_options_are_the_settings(self, run):
        settings = TrainingSettings.read(run / "settings.json")
        expected = TrainingSettings(
            task="joint", masks=1, head="plain", size=40, scenes=4, validation_scenes=1, batch=2, width=4, epochs=1,
            pretrain_epochs=1, lr=1e-3, seed=3, window=settings.window,
        )  # fmt: skip
        assert settings == expected
        assert TrainingSettings.of(load_trained(run / "best.safetensors")) == settings
        assert (run / "pretrain" / "last.safetensors").exists()

    def test_feature_resume_goes_on_and_refuses_other_settings(self, run, capsys, refused):
        assert main(["train", "--resume", "--epochs", "2", "-o", str(run)]) == 0
        assert "goes on, 2 epochs" in capsys.readouterr().out
        assert load_trained(run / "last.safetensors").step == 4
        assert "(stored / asked for): lr (0.001 / 1.0)" in refused(["train", "--resume", "--lr", "1", "-o", str(run)])
        assert "holds a run already" in refused(["train", "-o", str(run)])

    @pytest.mark.takes_seconds
    def test_feature_the_network_alone_has_defaults_of_its_own_and_a_learning_curve(self, tmp_path, capsys):
        run = tmp_path / "run"
        options = ["--learn", "network", "--crop", "32", "--epochs", "2", "--fidelity", "draft"]
        assert main(["train", *SMALL, *options, "-o", str(run)]) == 0
        assert "the network behind fixed optics" in capsys.readouterr().out
        settings = TrainingSettings.read(run / "settings.json")
        given = {"head": "plain", "width": 4, "size": 40, "crop": 32}
        given |= {"scenes": 4, "validation_scenes": 1, "batch": 2, "epochs": 2}
        assert {name: getattr(settings, name) for name in NETWORK_RUN} == {**NETWORK_RUN, **given}
        assert len(list((run / "captures" / "train").glob("*.npy"))) == 4
        assert read_image(run / "learning_curve.png").shape[-1] == 1575
        assert load_trained(run / "best.safetensors").step in (2, 4)
        both = ["--closed-form", "--head-from", str(run / "best.safetensors"), "--epochs", "1", "--fidelity", "draft"]
        assert load_trained(run / "best.safetensors").head.closed_form.inverse == "wiener"
        other = [*both, "--inverse", "tikhonov"]  # holds other PSFs, which are its camera's own
        assert main(["train", *SMALL, *other, "-o", str(tmp_path / "both")]) == 0
        joint = ["--task", "joint", "--depth-classes", "5", "--refocus", "2", *both]
        assert main(["train", *SMALL, *joint, "-o", str(tmp_path / "joint")]) == 0
        assert load_trained(tmp_path / "joint" / "best.safetensors").head.out_channels == 5 + 3
        refined = [*joint, "--refined", "--head-from", str(tmp_path / "joint" / "best.safetensors")]
        refined += ["--refiner-from", str(run / "best.safetensors")]
        assert main(["train", *SMALL, *refined, "-o", str(tmp_path / "refined")]) == 0
        assert load_trained(tmp_path / "refined" / "best.safetensors").head.refiner.out_channels == 3
        more = [*refined[:-2], "--learn", "refiner", "--head-from", str(tmp_path / "refined" / "best.safetensors")]
        assert main(["train", *SMALL, *more, "-o", str(tmp_path / "more")]) == 0
        before, after = (load_trained(tmp_path / name / "best.safetensors").head for name in ("refined", "more"))
        assert all(map(torch.equal, before.network.parameters(), after.network.parameters()))
        assert not any(map(torch.equal, before.refiner.parameters(), after.refiner.parameters()))

    @pytest.mark.takes_seconds
    def test_feature_a_deeper_network_that_sees_more_begins_as_one_that_was_trained(self, tmp_path, refused):
        """A rate of 1e-12 leaves it as it begins."""
        options = [*SMALL, "--head", "nafnet", "--width", "2", "--learn", "network", "--epochs", "1", "--ema", "0"]
        options += ["--fidelity", "draft", "--precision", "32-true", "--refocus", "2"]
        assert main(["train", *options, "-o", str(tmp_path / "shallow")]) == 0
        begun = ["--repeats", "2", "--fine", "--lr", "1e-12"]
        begun += ["--head-from", str(tmp_path / "shallow" / "best.safetensors")]
        assert main(["train", *options, *begun, "-o", str(tmp_path / "deep")]) == 0
        shallow, deep = (load_trained(tmp_path / name / "best.safetensors") for name in ("shallow", "deep"))
        assert len(deep.head.network.encoder[0]) == 2 * len(shallow.head.network.encoder[0])
        assert deep.head.network.in_channels == shallow.head.network.in_channels + 2
        joint = ["--task", "joint", "--learn", "both", "--closed-form"]
        joint += ["--head-from", str(tmp_path / "deep/best.safetensors")]
        assert "takes fine maps, and can begin only" in refused(["train", *options, *joint, "-o", str(tmp_path / "a")])
        capture = torch.rand(1, 3, 32, 32)
        with torch.no_grad():
            self.assert_close(deep.head(capture), shallow.head(capture), atol=1e-6, rtol=0)

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (["--repeats", "2"], "repeats are for the head nafnet, got 2 for 'plain'"),
            (["--refined"], "refined is for depth_classes with closed_form, which are not both asked for"),
            (["--refiner-from", "x"], "a network begins the refiner of refined, which is not asked for"),
            (["--captures", "x"], "--captures is for --learn network or refiner, got --learn both"),
            (["--size", "1000000"], "the scene has 1000000 x 1000000 pixels, more than 268435456"),
            (["--batch", "8"], "4 scenes do not fill a batch of 8"),
            *([] if torch.cuda.is_available() else [(["--accelerator", "gpu"], "PyTorch finds no GPU here")]),
            (["--head-from", "none.safetensors"], "cannot read none.safetensors: there is no such file"),
            (["--electrons", "9", "2"], "electrons must be least and largest, got 9.0 and 2.0"),
            (["--design-from", "nowhere"], "nowhere/report.json"),
        ],
    )
    def test_exception_is_one_sentence(self, options, sentence, tmp_path, refused):
        assert sentence in refused(["train", *SMALL, *options, "-o", str(tmp_path / "run")])

    def test_exception_processes_of_torchrun_that_devices_does_not_tell(self, tmp_path, monkeypatch, refused):
        """Each would train by itself, and overwrite what the others write."""
        monkeypatch.setenv("WORLD_SIZE", "2")
        assert "torchrun started, WORLD_SIZE=2, got 1" in refused(["train", *SMALL, "-o", str(tmp_path / "run")])
        assert not (tmp_path / "run").exists()

    def test_exception_without_lightning_is_one_sentence_before_any_work(self, tmp_path, monkeypatch, refused):
        monkeypatch.setitem(sys.modules, "lightning.pytorch", None)
        assert "pip install 'kornia-tidy[train]'" in refused(["train", "-o", str(tmp_path / "run")])
        assert not (tmp_path / "run").exists()

    @pytest.mark.takes_seconds
    def test_feature_the_command_imports_lightning_only_to_train(self, run):
        code = (
            "import sys; from kornia_tidy.cli import main; "
            f"main(['evaluate', {str(run / 'best.safetensors')!r}, '--scenes', '1', '-o', {str(run / 'e')!r}]); "
            "print('loaded', [n for n in ('lightning', 'tensorboard') if n in sys.modules])"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "loaded []"


class TestEvaluate(BaseTester):
    def test_feature_a_line_a_scene_means_and_pictures(self, run, tmp_path, capsys):
        out = tmp_path / "out"
        command = ["evaluate", str(run / "best.safetensors"), "-o", str(out), "--scenes", "3", "--pictures", "1"]
        assert main(command) == 0
        assert "3 scenes" in capsys.readouterr().out
        with (out / "results.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        summary = json.loads((out / "summary.json").read_text())
        assert [row["scene"] for row in rows] == ["0", "1", "2"]
        for name in ("depth_rmse", "image_rmse", "image_psnr"):
            mean = sum(float(row[name]) for row in rows) / 3
            assert summary["mean"][name] == pytest.approx(mean)
        assert summary["settings"]["task"] == "joint"
        estimate, truth, error = (
            read_image(out / f"scene_0000_image{suffix}.png") for suffix in ("", "_truth", "_error_x3")
        )
        # Estimates beyond [0, 1] are clipped in their picture, not in the error's.
        inside = (estimate > 0) & (estimate < 1)
        expected = (3 * (estimate - truth).abs()).clamp(max=1)
        assert inside.any()
        self.assert_close(error[inside], expected[inside], rtol=0, atol=4.1 / 255)
        assert not list(out.glob("scene_0001*"))

    def test_exception_is_one_sentence(self, tmp_path, refused):
        torch.save({}, tmp_path / "a.ckpt")
        assert "it is no checkpoint of kornia_tidy" in refused(["evaluate", str(tmp_path / "a.ckpt")])
        assert "a checkpoint, or a saved camera: there is no file" in refused(["evaluate", str(tmp_path / "b.ckpt")])
