from __future__ import annotations

import pytest
import torch

pytest.importorskip("matplotlib")

from kornia_tidy.figures.comparison import ZOOM, Panel, detail_of, draw_comparison
from tests.base import BaseTester

SCENE = torch.full((3, 64, 96), 0.5)
SCENE[:, 40:48:2, 20:28:2] = 1.0


class TestDrawComparison(BaseTester):
    def test_feature_each_picture_has_its_words_and_the_same_detail(self):
        blurred = SCENE * 0.5
        rows = [
            [Panel("scene", SCENE, "sharp"), Panel("capture", blurred, "20 dB")],
            [None, Panel("d", SCENE, "", False)],
        ]
        figure = draw_comparison(rows, "title", "subtitle", ["a note", "another"])
        assert [axes.get_title(loc="left") for axes in figure.axes] == ["scene", "capture", "", "d"]
        assert [axes.get_xlabel() for axes in figure.axes] == ["sharp", "20 dB", "", ""]
        assert [len(axes.child_axes) for axes in figure.axes] == [1, 1, 0, 0]
        top, left, side = detail_of(SCENE)
        shown = torch.from_numpy(figure.axes[1].child_axes[0].images[0].get_array()).permute(2, 0, 1)
        self.assert_close(shown.float(), blurred[:, top : top + side, left : left + side])
        assert figure.axes[0].child_axes[0].get_position().width == pytest.approx(
            figure.axes[0].get_position().width * ZOOM * side / 96, rel=0.01
        )
        texts = [text.get_text() for text in figure.texts]
        assert texts == ["title\nsubtitle", "a note\nanother"]

    def test_feature_the_detail_is_where_the_scene_is_finest(self):
        top, left, side = detail_of(SCENE)
        assert side == 8
        assert (abs(top - 40), abs(left - 20)) <= (1, 1)

    @pytest.mark.parametrize("rows", [[], [[]], [[None]]])
    def test_exception_without_the_scene(self, rows):
        with pytest.raises(ValueError, match="the first picture of a comparison must be the scene"):
            draw_comparison(rows, "", "", [])
