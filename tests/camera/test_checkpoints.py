"""Cameras that an earlier version saved: the captures of today's are those that it took."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file

from kornia_tidy.camera import camera_of_state
from tests.base import BaseTester
from tests.camera.checkpoints import CAPTURE, FOLDER, KINDS, OTHERS, capture_of, other_cameras

SAME = 1e-6  # full scale
TOLERANCES = {
    "bits": 1 / 1023 + SAME,  # rounding may decide for the next level
    "fast lens": 1e-2,  # layers stand closer near focus, where those of before erred by some 4e-3
}
# Those behind large windows take seconds.
NAMES = [pytest.param(k, marks=[pytest.mark.takes_seconds] * (k in ("ikoma2021", "liu2022-spiral"))) for k in KINDS]


def written(kind: str) -> dict[str, torch.Tensor]:
    return load_file(FOLDER / f"{kind.replace(' ', '_')}.safetensors")


@pytest.mark.filterwarnings("ignore:the (largest )?PSF window", "ignore:the paper's 23x23 pupil")
class TestCheckpoints(BaseTester):
    @pytest.mark.parametrize("kind", NAMES)
    def test_feature_a_camera_made_alike_or_of_it_takes_the_same_capture(self, kind):
        state = written(kind)
        before = state.pop(CAPTURE)
        optics = KINDS[kind]()
        optics.load_state_dict(state)
        for camera in (optics, *([] if kind == "measured" else [camera_of_state(state)])):
            self.assert_close(capture_of(camera), before, rtol=0, atol=TOLERANCES.get(kind, SAME))

    @pytest.mark.takes_seconds
    def test_feature_systems_and_measured_psfs(self):
        before = load_file(FOLDER / OTHERS)
        now = {name: capture_of(optics) for name, optics in other_cameras(FOLDER)}
        assert now.keys() == before.keys()
        for name, capture in now.items():
            self.assert_close(capture, before[name], rtol=0, atol=SAME)
