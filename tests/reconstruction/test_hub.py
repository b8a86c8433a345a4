"""Trained systems as folders with config, weights and card: written, read back, refused when damaged, downloaded."""

from __future__ import annotations

import json
import math
import sys
from types import ModuleType

import pytest
import torch
from safetensors.torch import load_file, save_file

from kornia_tidy.reconstruction.hub import from_pretrained, save_pretrained
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.trained import TrainedSystem, build_head, build_optics
from tests.base import BaseTester

SETTINGS = SystemSettings(
    task="joint", masks=2, head="plain", width=4, window=9, fidelity="draft", depth_range=(0.5, math.inf), sigma=0.003,
    focus_distance=math.inf,
)  # fmt: skip
RECORD = {"scores": {"test scenes": {"image_psnr": 21.5, "depth_rmse": math.nan}}, "minutes": 3}


@pytest.fixture
def system():
    torch.manual_seed(3)
    optics, head = build_optics(SETTINGS), build_head(SETTINGS)
    with torch.no_grad():
        for parameter in optics.masks.parameters():
            parameter.add_(torch.rand_like(parameter))
    return TrainedSystem(
        optics.eval(), head.eval(), SETTINGS, 12, {"data": "dead-leaves", "root": "/home/ada/x"}, RECORD
    )


def no_network(*_, **__):
    raise AssertionError("a folder must not connect to anything")


class TestSavePretrained(BaseTester):
    def test_feature_every_weight_setting_and_record_comes_back(self, system, tmp_path):
        folder = save_pretrained(system, tmp_path / "new" / "a")
        again = from_pretrained(folder)
        for one, other in ((system.optics, again.optics), (system.head, again.head)):
            assert not other.training
            for name, value in one.state_dict().items():
                assert torch.equal(value, other.state_dict()[name]), name
        assert again.settings == SETTINGS
        assert again.step == 12
        assert again.run == {"data": "dead-leaves", "root": None}  # the folder of the data is nobody's business
        assert again.record == {"scores": {"test scenes": {"image_psnr": 21.5, "depth_rmse": "nan"}}, "minutes": 3}

    def test_feature_files_are_those_of_the_mixins_and_standard_json(self, system, tmp_path):
        save_pretrained(system, tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "config.json", "model.safetensors"]
        config = json.loads((tmp_path / "config.json").read_text(), parse_constant=pytest.fail)
        assert config["library_name"] == "kornia_tidy"
        assert config["settings"]["depth_range"] == [0.5, "inf"]
        weights = load_file(tmp_path / "model.safetensors")
        assert {name.partition(".")[0] for name in weights} == {"optics", "head"}

    def test_feature_half_precision_is_that_of_the_network_alone(self, system, tmp_path):
        again = from_pretrained(save_pretrained(system, tmp_path, half=True))
        stored = load_file(tmp_path / "model.safetensors")
        assert {name.partition(".")[0] for name, value in stored.items() if value.dtype == torch.float16} == {"head"}
        assert torch.equal(again.optics.masks.phase, system.optics.masks.phase)
        for one, other in zip(system.head.parameters(), again.head.parameters(), strict=True):
            assert torch.equal(one.half().float(), other)

    def test_feature_an_edited_card_is_kept_and_weights_are_replaced(self, system, tmp_path):
        (tmp_path / "README.md").write_text("mine")
        save_pretrained(system, tmp_path)
        save_pretrained(system._replace(step=13), tmp_path)
        assert (tmp_path / "README.md").read_text() == "mine"
        assert from_pretrained(tmp_path).step == 13

    def test_exception_settings_that_describe_another_system_write_nothing(self, system, tmp_path):
        for wrong in ({"width": 5}, {"masks": 3}, {"focal_length": 0.035}):
            with pytest.raises(ValueError, match=r"the system|focal_length"):
                save_pretrained(system._replace(settings=SETTINGS.replace(**wrong)), tmp_path / "a")
            assert not (tmp_path / "a").exists()

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"record": {"scores": torch.ones(2)}}, "must be plain values for JSON"),
            ({"license": "do what\nyou: want"}, r"license must be an identifier such as .* got 'do what"),
        ],
    )
    def test_exception_values_that_cannot_be_written(self, options, sentence, system, tmp_path):
        with pytest.raises(ValueError, match=sentence):
            save_pretrained(system, tmp_path / "a", **options)
        assert not (tmp_path / "a").exists()

    def test_exception_a_file_in_the_place_of_the_folder(self, system, tmp_path):
        (tmp_path / "a").touch()
        with pytest.raises(ValueError, match="it is not a folder"):
            save_pretrained(system, tmp_path / "a")


class TestFromPretrained(BaseTester):
    @pytest.fixture
    def folder(self, system, tmp_path):
        return save_pretrained(system, tmp_path / "a")

    def test_feature_a_folder_needs_no_hub(self, folder, monkeypatch):
        hub = ModuleType("huggingface_hub")
        hub.hf_hub_download = no_network
        monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
        monkeypatch.chdir(folder.parent.parent)
        assert from_pretrained(f"{folder.parent.name}/a").step == 12  # looks like a repository, and is a folder

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            ({"format": "tarball"}, r"config.json: its format must be 'kornia_tidy system 1', got 'tarball'"),
            ({"settings": [1]}, r"settings must be values by name, got \[1\]"),
            ({"run": 5}, "run must be values by name, got 5"),
            ({"record": "good"}, "record must be values by name, got 'good'"),
            ({"global_step": "12"}, "without step or settings"),
            ({"settings": {**SETTINGS.as_dict(), "masks": 3, "depth_range": [0.5, "inf"]}}, "tell of 3"),
            ({"settings": {**SETTINGS.as_dict(), "depth_range": [0.5, "far"]}}, "depth_range must be a number of"),
        ],
    )
    def test_exception_a_config_that_cannot_be(self, change, sentence, folder):
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, **change}))
        with pytest.raises(ValueError, match=sentence):
            from_pretrained(folder)

    def test_exception_weights_that_are_pickled_or_do_not_fit(self, folder):
        weights = load_file(folder / "model.safetensors")
        save_file({**weights, "head.more": torch.ones(1)}, folder / "model.safetensors")
        with pytest.raises(ValueError, match=r"head does not fit: unknown more"):
            from_pretrained(folder)
        torch.save(weights, folder / "model.safetensors")
        with pytest.raises(ValueError, match="no safetensors file or is damaged"):
            from_pretrained(folder)

    def test_exception_nothing_there(self, folder, tmp_path, monkeypatch):
        for name in (tmp_path / "b", "a/b/c", "../b", "b"):
            with pytest.raises(FileNotFoundError, match=r"no folder .* the name of a repository is OWNER/NAME"):
                from_pretrained(name)
        (folder / "model.safetensors").unlink()
        with pytest.raises(FileNotFoundError, match=r"model\.safetensors: there is no such file"):
            from_pretrained(folder)
        monkeypatch.setitem(sys.modules, "huggingface_hub", None)
        with pytest.raises(ImportError, match=r"no folder ada/system, .* pip install 'kornia-tidy\[hub\]'"):
            from_pretrained("ada/system")

    def test_feature_a_repository_is_downloaded_file_by_file(self, folder, monkeypatch):
        asked = []

        def download(repository, file, **options):
            asked.append((repository, file, options["revision"]))
            return str(folder / file)

        hub = ModuleType("huggingface_hub")
        hub.hf_hub_download = download
        monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
        assert from_pretrained("ada/system", revision="v1").step == 12
        assert asked == [("ada/system", "config.json", "v1"), ("ada/system", "model.safetensors", "v1")]
