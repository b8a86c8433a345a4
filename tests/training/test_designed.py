from __future__ import annotations

import pytest
import torch

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.design import restoration_error
from kornia_tidy.masks import initial_heights
from kornia_tidy.reconstruction.trained import build_optics
from kornia_tidy.training.designed import SCENE_SPREAD, design_masks
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester

pl = pytest.importorskip("lightning.pytorch")

from kornia_tidy.training.module import TidyTraining  # noqa: E402
from kornia_tidy.training.run import train  # noqa: E402

SETTINGS = TrainingSettings(
    head="plain", width=4, size=32, scenes=2, validation_scenes=1, batch=2, epochs=1, fidelity="draft",
    start="focal sweep", design=20,
)  # fmt: skip


def swept(masks):
    heights = initial_heights("focal sweep", torch.Generator().manual_seed(0))[:masks]
    return TiDyOptics(PixelwiseMask(initial=heights), fidelity="draft")


def error(optics):
    optics.fidelity = optics.fidelity.replace(window=41, stray_light="discard")
    with torch.no_grad():
        return float(restoration_error(optics.psf_bank()))


class TestDesignMasks(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_five_masks_reach_what_one_does_not(self):
        """In windows of 41 pixels and 30 steps."""
        one, five = swept(1), swept(5)
        before = error(swept(1)), error(swept(5))
        for optics in (one, five):
            design_masks(optics, 30)
        after = error(one), error(five)
        assert after[0] < 0.6 * before[0]
        assert after[1] < 0.95 * before[1]
        assert after[1] < after[0]

    @pytest.mark.takes_seconds
    def test_feature_masks_are_designed_for_the_noise_given(self):
        """With a tenth of it, masks designed for that are better than the usual ones."""
        found = []
        for sigma in (0.0, 0.01):  # none counts as a tenth of the usual
            optics = swept(1)
            design_masks(optics, 60, sigma)
            optics.fidelity = optics.fidelity.replace(window=41, stray_light="discard")
            with torch.no_grad():
                found.append(float(restoration_error(optics.psf_bank(), 0.001 / SCENE_SPREAD)))
        assert found[0] < 0.9 * found[1]

    @pytest.mark.parametrize("steps", [0, -1])
    def test_exception_no_steps(self, steps):
        optics = swept(1)
        fidelity = optics.fidelity
        with pytest.raises(ValueError, match=f"iterations must be positive and finite, got {steps}"):
            design_masks(optics, steps)
        assert optics.fidelity == fidelity


class TestTrainingDesignedMasks(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_the_window_is_that_of_the_designed_masks(self):
        designed = TidyTraining.from_settings(SETTINGS.replace(masks=1))
        undesigned = build_optics(SETTINGS.replace(masks=1))
        assert designed.settings.window == designed.optics.window > undesigned.window
        assert TidyTraining.from_settings(SETTINGS.replace(masks=1, window=15, design=1)).optics.window == 15

    def test_feature_a_fixed_lens_stays(self):
        designed = TidyTraining.from_settings(SETTINGS.replace(masks=0))
        assert torch.equal(designed.optics.masks.phase, build_optics(SETTINGS.replace(masks=0)).masks.phase)

    def test_feature_a_run_that_goes_on_does_not_design_again(self, tmp_path, monkeypatch):
        settings = SETTINGS.replace(masks=1, design=2)
        train(settings, tmp_path)
        monkeypatch.setattr("kornia_tidy.training.module.design_masks", lambda *args, **options: pytest.fail("again"))
        module = train(settings.replace(epochs=2), tmp_path, resume=True)
        assert module.settings.window == TrainingSettings.read(tmp_path / "settings.json").window
