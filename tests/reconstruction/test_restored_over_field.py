"""Restoration behind a real lens, tile by tile."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.psf import PSFModel
from kornia_tidy.reconstruction import Wiener, restored_over_field
from tests.base import BaseTester

SETTINGS = Fidelity(window=25, layer_spacing=10.0)
CORNER = (450.0, 530.0)


def camera(**parts: object) -> TiDyOptics:
    masks = PixelwiseMask(1, initial="flat")
    settings = {"sensor": SensorNoise(0.002), "color_space": "linear", "fidelity": SETTINGS, **parts}
    return TiDyOptics(masks, lens="single-50mm", **settings)


class TestRestoredOverField(BaseTester):
    @pytest.mark.parametrize(("height", "width", "tile"), [(40, 57, 16), (9, 100, 31), (20, 20, 192)])
    @torch.no_grad()
    def test_feature_tiles_leave_no_seams(self, height, width, tile):
        """What restores nothing returns the capture, whatever the tiles."""
        capture = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0))
        model = camera().psf_model
        same = restored_over_field(capture, model, lambda part, bank: part, center=CORNER, tile=tile)
        self.assert_close(same, capture, rtol=0, atol=1e-6)

    @torch.no_grad()
    def test_feature_an_ideal_lens_is_restored_at_once(self):
        model, restore = PSFModel(fidelity=SETTINGS), Wiener(SensorNoise(0.01))
        capture = torch.rand(1, 3, 40, 50)
        whole = restore(capture, model.scene_bank(3, torch.float32, torch.tensor(model.camera.defocus_range)))
        assert torch.equal(restored_over_field(capture, model, restore), whole)

    def test_exception_tiles_of_a_pixel(self):
        with pytest.raises(ValueError, match="tile must be at least 2 pixels, got 1"):
            restored_over_field(torch.rand(1, 3, 8, 8), camera().psf_model, lambda part, bank: part, tile=1)
