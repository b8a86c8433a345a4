"""The model card: every number in it comes from settings or record, and what is not recorded is said to be unknown."""

from __future__ import annotations

import re

import pytest
import torch

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.reconstruction.model_card import model_card
from kornia_tidy.reconstruction.pretrained import PRETRAINED, pretrained_record
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.trained import TrainedSystem
from tests.base import BaseTester
from tests.reconstruction.shipped import shipped

SECTIONS = ["Use", "Camera and network", "Training", "Scores", "Intended use", "Limits", "Licence", "Citation"]


def untrained(**settings):
    return TrainedSystem(TiDyOptics(), None, SystemSettings(**settings), 7)


class TestModelCard(BaseTester):
    @pytest.mark.parametrize("name", PRETRAINED)
    @pytest.mark.takes_seconds
    def test_smoke_sections_of_each_shipped_system(self, name):
        card = model_card(shipped(name)._replace(record=pretrained_record(name)), name, "apache-2.0")
        assert re.findall(r"^## (.*)$", card, re.MULTILINE) == SECTIONS
        for table in re.findall(r"(?:^\|.*\n)+", card, re.MULTILINE):
            assert len({line.count("|") for line in table.splitlines()}) == 1

    def test_feature_numbers_of_settings_run_and_record(self):
        record = {
            "seed": 41,
            "minutes": 8.25,
            "scores": {"desk | lamp": {"image_psnr": 23.456, "other": 2}, "b": {"other": 5}},
        }
        system = untrained(sigma=0.0123, depth_range=(0.5, 2.0))._replace(
            run={"data": "nyu", "scenes": 795, "epochs": 3}, record=record
        )
        rows = {
            cells[0]: cells[1:] for line in model_card(system, "t").splitlines() if (cells := line.split(" | "))[1:]
        }
        rows = {name.removeprefix("| "): [cell.removesuffix(" |") for cell in cells] for name, cells in rows.items()}
        told = {"read noise": "0.0123 of full scale", "range of depth": "0.5 m to 2 m", "data": "nyu", "scenes": "795"}
        told |= {"steps of the optimiser": "7", "seed": "41", "minutes": "8.25", "epochs": "3"}
        assert {name: rows[name] for name in told} == {name: [value] for name, value in told.items()}
        assert rows["PSNR of the image, dB"] == ["23.46", ""]
        assert rows["other"] == ["2", "5"]
        assert rows["score"] == [r"desk \| lamp", "b"]

    @pytest.mark.parametrize(("height", "words"), [(1e-7, "a lens without masks"), (None, "1 learnt phase mask ")])
    def test_feature_masks_are_those_the_camera_has(self, height, words):
        heights = torch.rand(1, 23, 23) * 1e-7 if height is None else torch.full((1, 23, 23), height)
        for start in ("flat", "noise"):  # masks may come from a file, however the settings say they start
            system = untrained(masks=1, start=start)._replace(optics=TiDyOptics(PixelwiseMask(initial=heights)))
            assert f"A simulated camera with {words}" in model_card(system, "t")

    def test_feature_what_is_not_recorded_is_said_to_be_unknown(self):
        card = model_card(untrained(), "t")
        assert "Which data it was trained on is unknown" in card
        assert "None are recorded" in card
        assert "None is given" in card
        assert "license:" not in card

    @pytest.mark.parametrize(("task", "tag"), [("edof", "image-to-image"), ("joint", "depth-estimation")])
    def test_feature_metadata_is_what_the_hub_reads(self, task, tag):
        head = model_card(untrained(task=task), "t", "cc-by-nc-4.0").split("---\n")[1].splitlines()
        assert head[:3] == ["library_name: kornia_tidy", "license: cc-by-nc-4.0", f"pipeline_tag: {tag}"]
        assert head[3] == "tags:"
        assert all(re.fullmatch(r"- [a-z_-]+", line) for line in head[4:])

    def test_feature_noise_and_certainty_are_those_of_the_training(self):
        run = {"data": "photo-collages", "learn": "network", "noise_range": [0.001, 0.03]}
        card = model_card(untrained(task="joint", depth_classes=21, refocus=9)._replace(run=run), "t")
        for sentence in ("noise of 0.001 to 0.03", "collages of photographs", "It tells how sure it is"):
            assert sentence in card
        assert "does not tell" not in card
        card = model_card(untrained(task="joint", sigma=0.004)._replace(run={**run, "learn": "both"}), "t")
        for sentence in ("a noise of 0.004 of full scale. Other noise", "does not tell how sure"):
            assert sentence in card

    def test_feature_a_title_of_several_lines_stays_a_title(self):
        assert "\n# a # b\n" in model_card(untrained(), "a\n# b")
