"""The systems that come with the library."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from kornia_tidy import reconstruct
from kornia_tidy.choices import REPLACED
from kornia_tidy.cli.app.settings import Settings
from kornia_tidy.data import DeadLeaves
from kornia_tidy.lab.named_system import head_file
from kornia_tidy.reconstruction.pretrained import (
    FOLDER,
    PRETRAINED,
    about_pretrained,
    load_pretrained,
    pretrained_record,
    pretrained_settings,
)
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.reconstruction.trained import load_trained, load_weights
from kornia_tidy.training.evaluation import evaluate, mean_row
from tests.base import BaseTester
from tests.benchmarks.shipped_files import ship
from tests.reconstruction.shipped import shipped

MEGABYTES = 25  # that all of them may take


class TestPretrained(BaseTester):
    @pytest.mark.parametrize("name", PRETRAINED)
    @pytest.mark.takes_seconds
    def test_feature_beats_its_capture_on_new_scenes(self, name):
        """The scores that heads.json tells, on other scenes than those it was measured on."""
        system = shipped(name)
        task, kind = name.split("-")
        masks = {"designed": 5, "flat": 1, "uncertain": 5}
        assert (system.settings.task, system.settings.masks) == (task, masks.get(kind) or int(kind))
        assert not system.head.training
        captures = []

        def note(result):
            captures.append(-10 * (result.coded - result.truth["image"]).square().mean().log10())

        scenes = DeadLeaves(2, 128, 128, depth_range=system.optics.camera.depth_range, seed=31)
        scores = mean_row(evaluate(system, scenes, each=note))
        told = about_pretrained()["systems"][name]["scores"]["dead leaves"]
        gain = told["image_psnr"] - told["capture_psnr"]
        assert scores["image_psnr"] > float(torch.stack(captures).mean()) + gain / 2
        assert abs(scores["image_psnr"] - told["image_psnr"]) < 2.5
        if "depth_rmse" in told:
            assert scores["depth_rmse"] < told["depth_rmse"] + 0.1

    @pytest.mark.takes_seconds
    def test_feature_loading_does_not_import_the_compiler_of_torch(self):
        """Its import takes longer than loading."""
        code = (
            "import sys; from kornia_tidy.reconstruction.pretrained import load_pretrained; load_pretrained('edof-5'); "
            "sys.exit('torch._dynamo' in sys.modules)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    def test_feature_all_are_small(self):
        assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < MEGABYTES << 20

    def test_feature_what_is_shipped_is_what_was_trained(self, tmp_path):
        state = read_state(FOLDER / "edof-5.safetensors")
        weights = dict(state["state_dict"])
        state["state_dict"] = {**weights, "head.extra": torch.ones(1000, 1000), "average.steps": torch.tensor(1)}
        settings = {**state["settings"], "root": "a place on one machine"}
        write_state(tmp_path / "run.safetensors", {**state, "settings": settings, "optimizer": {"lr": 1.0}})
        ship(tmp_path / "run.safetensors", tmp_path / "small.safetensors", short=False)
        again = read_state(tmp_path / "small.safetensors")
        assert set(again) == {"settings", "global_step", "state_dict"}
        assert again["settings"] == {**state["settings"], "root": None}
        assert again["state_dict"].keys() == weights.keys()
        assert all(torch.equal(again["state_dict"][key], value) for key, value in weights.items())

    def test_feature_psfs_are_left_out_and_computed_from_the_masks(self, tmp_path):
        system, state = load_pretrained("edof-5"), read_state(FOLDER / "edof-5.safetensors")
        name, veil = (f"average.network.closed_form.{part}" for part in ("psfs", "veil"))
        own = {name: system.head.closed_form.psfs + 1.0, veil: system.head.closed_form.veil + 0.1}  # of another camera
        state["state_dict"] = {**state["state_dict"], **own}
        write_state(tmp_path / "run.safetensors", state)
        ship(tmp_path / "run.safetensors", tmp_path / "small.safetensors", short=False)
        assert read_state(tmp_path / "small.safetensors")["state_dict"][name].numel() == 0
        again = load_trained(tmp_path / "small.safetensors").head.closed_form
        assert torch.equal(again.psfs, system.head.closed_form.psfs)
        assert torch.equal(again.kernels, system.head.closed_form.kernels)
        capture = torch.rand(1, 3, 64, 64)
        with torch.no_grad():
            expected = system.head(capture)
            load_weights(tmp_path / "small.safetensors", head=system.head)  # which keeps its own
            assert torch.equal(system.head(capture), expected)

    def test_feature_networks_are_shipped_in_eight_bits_and_loaded_in_single(self, tmp_path):
        whole = load_trained(FOLDER / "edof-flat.safetensors")
        ship(FOLDER / "edof-flat.safetensors", tmp_path / "short.safetensors")
        weights = list(whole.head.parameters())
        count, channels = sum(weight.numel() for weight in weights), sum(len(weight) for weight in weights)
        others = sum(value.numel() for part in whole[:2] for value in part.state_dict().values()) - count
        most = count + 4 * (channels + others) + 2**17  # a scale for each channel, and a header
        assert (tmp_path / "short.safetensors").stat().st_size < most
        short = load_trained(tmp_path / "short.safetensors")
        assert torch.equal(short.optics.masks.phase, whole.optics.masks.phase)
        for one, other in zip(weights, short.head.parameters(), strict=True):
            axes = tuple(range(1, one.ndim)) if one.ndim > 1 else 0
            assert ((one - other).abs() <= one.abs().amax(axes, keepdim=True) / 250).all()

    def test_exception_a_run_without_an_average(self, tmp_path):
        state = read_state(FOLDER / "edof-5.safetensors")
        state["state_dict"] = {k: v for k, v in state["state_dict"].items() if k.startswith("optics.")}
        write_state(tmp_path / "run.safetensors", state)
        with pytest.raises(ValueError, match="holds no moving average of its network"):
            ship(tmp_path / "run.safetensors", tmp_path / "small.safetensors")
        assert not (tmp_path / "small.safetensors").exists()

    def test_exception_unknown_name(self):
        with pytest.raises(ValueError, match="name must be one of"):
            load_pretrained("edof-7")

    @pytest.mark.parametrize("name", REPLACED)
    def test_exception_a_system_of_an_earlier_version_names_what_took_its_place(self, name):
        sentence = f"the system {name!r} is no longer shipped: {REPLACED[name]!r} took its place"
        for refuse in (load_pretrained, pretrained_settings, pretrained_record, head_file):
            with pytest.raises(ValueError, match=sentence):
                refuse(name)
        with pytest.raises(ValueError, match=sentence):
            reconstruct(np.zeros((4, 4, 3), np.uint8), name)
        with pytest.raises(ValueError, match=sentence):
            Settings(camera=name)
