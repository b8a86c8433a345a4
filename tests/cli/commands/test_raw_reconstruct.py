"""`raw reconstruct`: a batch survives a bad file, an interrupt and a second start, and writes what it says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_depth, read_image
from kornia_tidy.figures import style
from kornia_tidy.lab import capture_file
from kornia_tidy.lab.raw import RawCapture, develop, simulate_raw
from kornia_tidy.lab.raw.dng_writer import encode_dng
from kornia_tidy.lab.raw.tags import NOISE_PROFILE
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import load_trained
from kornia_tidy.training.module import TidyTraining
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester
from tests.lab.raw.dng import DOUBLE, dng

ENDS = [".png", ".jpg", "_depth.png", "_depth.pfm", "_depth.npy", "_depth_colors.png", ".json"]


def checkpoint(path, seed=0, width=4, **settings):
    """An untrained system whose network looks 31 pixels far."""
    torch.manual_seed(seed)
    settings = TrainingSettings(masks=1, window=23, ema=0, head="plain", width=width, **settings)
    training = TidyTraining.from_settings(settings)
    for parameter in training.head.parameters():
        if not parameter.any():  # the last convolution behind a closed form
            torch.nn.init.normal_(parameter, std=0.02)
    write_state(path, {"settings": training.settings.as_dict(), "state_dict": training.state_dict(), "global_step": 3})
    return str(path)


def capture(path, seed=0, size=(90, 110)):
    picture = np.random.default_rng(seed).integers(0, 65535, (*size, 3), np.uint16)
    cv2.imwrite(str(path), cv2.GaussianBlur(picture, (0, 0), 3))
    return str(path)


def raw_file(size=(60, 80), seed=0):
    """Write a DNG of a camera with the colours of sRGB."""
    light = torch.rand(3, *size, generator=torch.Generator().manual_seed(seed))
    camera = RawCapture.from_counts(torch.zeros(1, 2, 2), "RGGB", 256, 4095)
    camera = replace(camera, camera_to_srgb=torch.eye(3), white_balance=torch.ones(4))
    return encode_dng(simulate_raw(light, camera))


@pytest.fixture
def batch(tmp_path):
    files = [capture(tmp_path / f"{name}.png", seed) for seed, name in enumerate("abc")]
    return files, checkpoint(tmp_path / "joint.safetensors", task="joint"), tmp_path / "out"


def reconstruct(files, weights, folder, *options):
    return main(["raw", "reconstruct", *files, "--head", weights, "-o", str(folder), *options])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class TestRawReconstruct(BaseTester):
    def test_smoke_all_results_are_there(self, batch, capsys):
        files, weights, folder = batch
        assert reconstruct(files, weights, folder) == 0
        assert sorted(contents(folder)) == sorted(f"{name}{end}" for name in "abc" for end in ENDS)
        out = capsys.readouterr().out
        assert out.count("110 x 90") == 3
        assert "3 of 3 in" in out

    def test_feature_files_hold_what_the_library_computes(self, batch):
        files, weights, folder = batch
        assert reconstruct(files[:1], weights, folder, "--linear") == 0
        head = LightHead(load_trained(weights))
        image, depth, _ = reconstruct_light(head, read_image(files[0]))
        assert (read_image(folder / "a.png") - image).abs().max() <= 0.5 / 65535 + 1e-7
        assert (read_image(folder / "a.jpg") - image).abs().mean() < 0.02
        exact = np.load(folder / "a_depth.npy")
        assert np.array_equal(exact, depth[0].numpy())
        self.assert_close(read_depth(folder / "a_depth.pfm").depth, depth)
        units = cv2.imread(str(folder / "a_depth.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(units, np.clip(np.rint(exact.astype(float) / 0.001), 1, 65535))
        record = json.loads((folder / "a.json").read_text())
        assert record["size"] == [110, 90]
        assert record["depth_png"] == "metres = value * 0.001; 65535 is 65.535 m or farther"

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("closed_form", [True, False])
    def test_feature_uncertainty_is_a_second_map(self, closed_form, tmp_path, capsys):
        options = {"task": "joint", "depth_classes": 6, "refocus": 2, "closed_form": closed_form}
        weights = checkpoint(tmp_path / "joint.safetensors", **options)
        folder, file = tmp_path / "out", capture(tmp_path / "a.png")
        assert reconstruct([file], weights, folder, "--linear", "--depth-unit", "0.01") == 0
        maps = [f"a_deviation{end}" for end in (".png", ".pfm", ".npy")]
        assert sorted(contents(folder)) == sorted([*(f"a{end}" for end in ENDS), *maps])
        result = reconstruct_light(LightHead(load_trained(weights)), read_image(file))
        exact = np.load(folder / "a_deviation.npy")
        assert np.array_equal(exact, result.deviation[0].numpy())
        assert np.array_equal(np.load(folder / "a_depth.npy"), result.depth[0].numpy())
        self.assert_close(read_depth(folder / "a_deviation.pfm").depth, result.deviation)
        units = cv2.imread(str(folder / "a_deviation.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(units, np.clip(np.rint(exact.astype(float) / 0.01), 1, 65535))
        record = json.loads((folder / "a.json").read_text())
        assert record["deviation_png"] == "metres = value * 0.01; 65535 is 655.35 m or more, or unbounded"
        with pytest.raises(SystemExit):
            main(["raw", "reconstruct", "--help"])
        assert "uncertainty of the depth: its standard deviation" in capsys.readouterr().out

    def test_feature_orientations_are_averaged(self, tmp_path, capsys):
        weights = checkpoint(tmp_path / "edof.safetensors", task="edof", closed_form=True)
        folder, file = tmp_path / "out", capture(tmp_path / "a.png")
        assert reconstruct([file], weights, folder, "--linear", "--orientations", "4") == 0
        found, system = read_image(folder / "a.png"), load_trained(weights)
        alone, averaged = (reconstruct_light(LightHead(system, None, n), read_image(file)).image for n in (1, 4))
        assert (found - averaged).abs().max() <= 0.5 / 65535 + 1e-7
        assert (found - alone).abs().max() > 1e-3
        assert json.loads((folder / "a.json").read_text())["settings"]["orientations"] == 4
        other = checkpoint(tmp_path / "other.safetensors", task="edof")
        assert reconstruct([file], other, folder, "--orientations", "4") == 2
        assert "is for a network that begins with the closed form" in capsys.readouterr().err

    def test_feature_an_image_task_has_no_depth(self, tmp_path):
        weights = checkpoint(tmp_path / "edof.safetensors", task="edof")
        assert reconstruct([capture(tmp_path / "a.png")], weights, tmp_path / "out", "--format", "tiff") == 0
        assert sorted(contents(tmp_path / "out")) == ["a.jpg", "a.json", "a.tif"]

    def test_feature_a_bad_file_does_not_stop_the_rest(self, batch, capsys):
        files, weights, folder = batch
        bad = [str(folder.parent / name) for name in ("bad.png", "cut.dng", "missing.png")]
        for path, start in zip(bad[:2], (b"no picture", raw_file()[:5000]), strict=True):
            Path(path).write_bytes(start)
        assert reconstruct([files[0], *bad, *files[1:]], weights, folder) == 2
        out, err = capsys.readouterr()
        assert {path.stem for path in folder.glob("*.json")} == {"a", "b", "c"}
        lines = [line.split(maxsplit=1) for line in out.splitlines()[1:-1] if not line.startswith("note")]
        assert [file for file, _ in lines] == ["file", files[0], *bad, *files[1:]]  # the table, in the order asked for
        assert [said.endswith("done") for _, said in lines[1:]] == [True, False, False, False, True, True]
        reasons = ("not an image", "it is cut short", "there is no such file")
        for (_, said), reason in zip(lines[2:5], reasons, strict=True):
            assert reason in said
            assert reason in err
        assert "3 of 6 files failed" in err
        assert "Traceback" not in err

    def test_feature_not_even_a_mistake_of_ours_stops_the_rest(self, batch, monkeypatch, capsys):
        files, weights, folder = batch

        def read(path):
            if path == files[1]:
                raise RuntimeError("out of memory\nallocated 5 of 4 GiB")
            return read_image(path)

        monkeypatch.setattr(capture_file, "read_image", read)
        assert reconstruct(files, weights, folder) == 2
        assert "out of memory allocated 5 of 4 GiB\n" in capsys.readouterr().out
        assert {path.stem for path in folder.glob("*.json")} == {"a", "c"}

    @pytest.mark.takes_seconds
    def test_feature_interrupted_and_resumed_is_as_if_nothing_had_been(self, batch, monkeypatch, capsys):
        files, weights, folder = batch
        assert reconstruct(files, weights, folder.with_name("whole")) == 0

        def interrupting(path, data):
            if path.name == "b_depth_colors.png":  # all of the first file's results, and some of the second's
                raise KeyboardInterrupt
            write(path, data)

        write = style.write_bytes
        monkeypatch.setattr(style, "write_bytes", interrupting)
        assert reconstruct(files, weights, folder) == 130
        assert (folder / "a.json").exists()
        assert (folder / "b.png").exists()
        assert not (folder / "b.json").exists()
        assert not list(folder.glob(".*"))
        assert "interrupted" in capsys.readouterr().err
        monkeypatch.undo()
        before = (folder / "a.png").stat().st_mtime_ns
        (folder / f".{32 * 'a'}.tmp").write_bytes(b"what somebody killed was writing")
        assert reconstruct(files, weights, folder, "--resume") == 0
        assert (folder / "a.png").stat().st_mtime_ns == before
        assert "kept" in capsys.readouterr().out
        assert contents(folder) == contents(folder.with_name("whole"))

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("change", ["checkpoint", "file", "option", "missing", "record", "none"])
    def test_feature_resume_keeps_only_what_is_still_right(self, batch, change, capsys):
        files, weights, folder = batch
        assert reconstruct(files[:1], weights, folder) == 0
        options = ["--resume"]
        if change == "checkpoint":
            checkpoint(weights, seed=1, task="joint")
        elif change == "file":
            capture(files[0], seed=9)
        elif change == "option":
            options += ["--depth-unit", "0.002"]
        elif change == "missing":
            (folder / "a_depth.pfm").unlink()
        elif change == "record":
            (folder / "a.json").write_text("{")
        capsys.readouterr()
        assert reconstruct(files[:1], weights, folder, *options) == 0
        assert ("kept" in capsys.readouterr().out) == (change == "none")
        assert (folder / "a_depth.pfm").exists()

    @pytest.mark.takes_seconds
    def test_feature_a_network_that_comes_with_the_library_needs_no_checkpoint(self, tmp_path, capsys):
        (tmp_path / "a.dng").write_bytes(raw_file())
        assert reconstruct([str(tmp_path / "a.dng")], "edof-flat", tmp_path) == 0
        assert json.loads((tmp_path / "a.json").read_text())["head"] == "edof-flat"
        light = develop(RawCapture.open(tmp_path / "a.dng"), encoded=False, upright=False)
        image, *_ = reconstruct_light(LightHead(load_pretrained("edof-flat")), light)
        assert (read_image(tmp_path / "a.png") - image).abs().max() <= 0.5 / 65535 + 1e-6

    def test_feature_the_noise_of_a_raw_file_is_told_to_its_network(self, tmp_path, capsys):
        """By its noise profile, or as it is given; files of less noise get less of it taken away."""
        system = checkpoint(tmp_path / "closed.safetensors", task="edof", closed_form=True)
        counts = 64 + 400 * (np.indices((90, 110)).sum(0) // 24 % 2) + np.random.default_rng(0).normal(0, 20, (90, 110))
        profiles = {"quiet": [1e-6, 1e-8], "loud": [1e-3, 1e-4]}
        for name, values in profiles.items():
            data = dng(counts.clip(0).round().astype(np.uint16), extra={NOISE_PROFILE: (DOUBLE, values)})
            (tmp_path / f"{name}.dng").write_bytes(data)
        files = [str(tmp_path / f"{name}.dng") for name in profiles]
        assert reconstruct(files, system, tmp_path / "profile") == 0
        quiet, loud = (read_image(tmp_path / "profile" / f"{name}.png") for name in profiles)
        assert loud.diff().square().mean() < quiet.diff().square().mean()
        told = json.loads((tmp_path / "profile" / "loud.json").read_text())["noise"]
        assert told.startswith("read noise 0.0")
        assert reconstruct(files, system, tmp_path / "given", "--noise", "0.03") == 0
        given = [read_image(tmp_path / "given" / f"{name}.png") for name in profiles]
        assert torch.equal(*given)
        plain = checkpoint(tmp_path / "plain.safetensors", task="edof")
        assert reconstruct(files, plain, tmp_path / "no", "--noise", "0.03") == 2
        assert "--noise is for a network that takes it" in capsys.readouterr().err
        assert reconstruct(files, system, tmp_path / "no", "--noise", "0") == 2

    def test_exception_is_one_sentence_before_any_work(self, batch, capsys):
        files, weights, folder = batch
        (folder.parent / "sub").mkdir()
        twin = capture(folder.parent / "sub" / "a.png")
        wide = checkpoint(folder.parent / "wide.safetensors", width=64)
        for words, sentence in (
            ([[*files, twin], weights, folder], "would both become"),
            ([files, weights, folder.parent], "it is an input"),
            ([files, files[0], folder], "is no checkpoint of kornia_tidy"),
            (
                [files, "edof-7", folder],
                f"a system is {', '.join(PRETRAINED)}, a checkpoint, or a saved camera: there is no file edof-7",
            ),
            ([files, wide, folder, "--memory", "1"], "the smallest tile of this head"),
        ):
            assert reconstruct(*words) == 2
            assert sentence in capsys.readouterr().err
        assert not folder.exists() or not list(folder.iterdir())
