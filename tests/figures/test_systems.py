from __future__ import annotations

import pytest
import torch
from matplotlib.text import Text

from kornia_tidy import DefocusRange, TiDyOptics
from kornia_tidy.figures.system_statistics import system_statistics
from kornia_tidy.figures.systems import Portrait, draw_systems
from kornia_tidy.optics import published_system
from tests.base import BaseTester


def portrait(name, **overrides):
    optics = TiDyOptics.from_preset(name, **overrides)
    return Portrait(published_system(name), optics, system_statistics(optics, nodes=7), torch.rand(3, 20, 30))


class TestDrawSystems(BaseTester):
    def test_smoke_every_row_tells_its_system(self):
        """tidy-5 has a fan of masks; a plain lens in focus has an infinite bound, which must not spoil the scale."""
        rows = [portrait("tidy-5"), portrait("chang2019"), portrait("fresnel")]
        figure = draw_systems(rows, torch.rand(3, 20, 30), torch.rand(1, 20, 30), "leaves")
        words = " ".join(text.get_text() for text in figure.findobj(Text))
        for part in ("TiDy, five masks", "Chang and Wetzstein", "Fresnel lens", "leaves", "50 mm f/8", "guessed: "):
            assert part in words
        # mask and PSFs, contrast and capture; below is the scene twice
        assert sum(len(axes.images) for axes in figure.axes) == 3 * (1 + 7 + 2) + 2

    def test_exception_nothing_to_draw(self):
        with pytest.raises(ValueError, match="no systems were given"):
            draw_systems([], torch.rand(3, 20, 30), torch.rand(1, 20, 30), "leaves")

    def test_exception_cameras_must_know_metres(self):
        with pytest.raises(ValueError, match="lenses that know metres, got DefocusRange"):
            draw_systems(
                [portrait("tidy-1", camera=DefocusRange())], torch.rand(3, 20, 30), torch.rand(1, 20, 30), "leaves"
            )
