"""Names that settings choose from are those of what they name."""

from __future__ import annotations

import pytest

from kornia_tidy import choices
from kornia_tidy.camera import tidy_optics
from kornia_tidy.design.tradeoff import PLAN, SWEEP_VALUES
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.lab.mask_export import placement
from kornia_tidy.lab.raw.demosaic import METHODS
from kornia_tidy.lab.raw.develop import HIGHLIGHTS
from kornia_tidy.modulator import switching
from kornia_tidy.optics import SYSTEMS
from kornia_tidy.optics.holes import HOLES
from kornia_tidy.optics.lens import NAMED_LENSES
from kornia_tidy.psf import psf_bank
from kornia_tidy.reconstruction import metrics
from kornia_tidy.reconstruction.head_names import ANY_CAMERA
from kornia_tidy.reconstruction.pretrained import FOLDER
from kornia_tidy.reconstruction.self_ensemble import ORIENTATIONS
from kornia_tidy.reconstruction.tasks import MAPS
from kornia_tidy.render import borders, compositing
from kornia_tidy.settings import settings_of
from kornia_tidy.training import data_sets, settings, task_loss
from kornia_tidy.training.coded_datasets import layout
from tests.base import BaseTester


class TestChoices(BaseTester):
    @pytest.mark.parametrize(
        ("name", "named"),
        [
            ("TASKS", MAPS),
            ("COMPOSITING", compositing.COMPOSITING),
            ("BORDERS", borders.BORDERS),
            ("STRAY_LIGHT", psf_bank.STRAY_LIGHT),
            ("COLOR_SPACES", tidy_optics.COLOR_SPACES),
            ("HOLES", HOLES),
            ("SYSTEMS", SYSTEMS),
            ("LENSES", NAMED_LENSES),
            ("SPLITS", data_sets.SPLITS),
            ("BESIDE", layout.BESIDE),
            ("BETWEEN", switching.BETWEEN),
            ("FLIPS", placement.FLIPS),
            ("ROTATIONS", placement.ROTATIONS),
            ("ORIENTATIONS", ORIENTATIONS),
            ("KNOBS", (*SWEEP_VALUES, PLAN)),
            ("DEMOSAIC", METHODS),
            ("HIGHLIGHTS", HIGHLIGHTS),
        ],
    )
    def test_feature_names_are_those_of_what_they_name(self, name, named):
        assert getattr(choices, name) == tuple(named)

    def test_feature_pretrained_are_the_files(self):
        assert {*choices.PRETRAINED, ANY_CAMERA} == {path.stem for path in FOLDER.glob("*.safetensors")}

    def test_feature_settings_of_training(self):
        assert tuple(settings.DATA) == tuple(data_sets.SCENES)
        assert tuple(settings.LOSS) == tuple(task_loss.LOSSES)
        assert settings.SSIM_WINDOW == metrics.SSIM_WINDOW
        assert {one.name: one for one in settings_of(settings.TrainingSettings)}["fidelity"].unit.choices == tuple(
            PRESETS
        )
