from __future__ import annotations

import pytest
import torch

from kornia_tidy import PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.lab.raw.point_targets import FINE, points_of_light
from tests.base import BaseTester


@pytest.fixture(scope="module")
def optics():
    return TiDyOptics(PixelwiseMask(1, initial="flat"))


class TestPointsOfLight(BaseTester):
    def test_feature_points_are_alike_and_lie_between_pixels(self, optics):
        """In focus a lens is symmetric, so the centre of the light is the point: on a fifth of a pixel, up to one away.

        The light in the cell of each is the same, but for the windows' ends; that of a pixel is not.
        """
        light = points_of_light(optics, 0.595, 6, (64, 96), generator=torch.Generator().manual_seed(0))
        cells = light.double().unfold(1, 32, 32).unfold(2, 32, 32).flatten(1, 2)  # (3, 6, 32, 32)
        total = cells.sum((2, 3))
        self.assert_close(total, total[:, :1].expand(-1, 6), rtol=1e-5)
        x = torch.arange(32, dtype=torch.float64) - 15
        places = torch.stack([(cells.sum(3) @ x) / total, (cells.sum(2) @ x) / total], -1)
        fifths = places * FINE
        assert float((fifths - fifths.round()).abs().max()) < 0.02
        assert float(places.abs().max()) <= 1 + 0.01
        assert len({tuple(place) for place in fifths[0].round().int().tolist()}) > 3

    def test_feature_on_a_pixel_it_is_the_psf_of_the_camera(self, optics):
        """Of the whole light, not of a renormalised window; the two integrate over pixels in steps of their own."""
        psi = float(optics.camera.defocus(torch.tensor(0.8)))
        fidelity = optics.fidelity.replace(window=45, stray_light="discard")
        psf = optics.with_fidelity(fidelity).psf_bank(defocus=[psi]).psfs[0].detach()
        draws = (torch.Generator().manual_seed(seed) for seed in range(2000))
        unmoved = next(g for g in draws if not torch.randint(-FINE, FINE + 1, (2,), generator=g).any())
        unmoved.manual_seed(unmoved.initial_seed())
        light = points_of_light(optics, 0.8, 1, (48, 48), generator=unmoved)
        self.assert_close(light[:, 1:46, 1:46], psf / psf.max(), atol=2e-3, rtol=0)

    def test_feature_one_channel_is_green(self, optics):
        assert points_of_light(optics, 0.6, 2, (48, 96), channels=1).shape == (1, 48, 96)

    def test_exception_is_one_sentence(self, optics):
        bank = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-5.0, 5.0]))
        for camera, count, sentence in (
            (optics.with_bank(bank), 1, "points of light lie between pixels"),
            (optics, 100, "100 points need a sensor of 384 x 288 pixels or more, got 64 x 48"),
            (optics, 0, "count must be positive"),
        ):
            with pytest.raises(ValueError, match=sentence):
                points_of_light(camera, 0.5, count, (48, 64))
