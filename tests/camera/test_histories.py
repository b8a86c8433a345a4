"""A capture depends on its camera and its scene: not on what the camera did before, nor on the way it is taken."""

from __future__ import annotations

import random
from itertools import count

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from tests.base import BaseTester
from tests.camera.histories import WAYS, draw_history, live

QUICK = ("default", "range", "ring")  # lenses


@st.composite
def histories(draw: st.DrawFn) -> object:
    return draw_history(lambda values: draw(st.sampled_from(values)))


class TestHistories(BaseTester):
    @given(history=histories())
    @settings(max_examples=5)
    def test_property_a_capture_is_that_of_a_new_camera(self, history):
        finding = live(history)
        assert not finding.wrong, finding

    @pytest.mark.parametrize("way", WAYS)
    def test_feature_each_way_after_some_events(self, way):
        """But not behind wide or real lenses, which take seconds: the property draws them."""
        chosen = random.Random(way)
        drawn = (draw_history(lambda values: way if way in values else chosen.choice(values)) for _ in count())
        history = next(each for each in drawn if each.camera.lens in QUICK)
        finding = live(history)
        assert not finding.wrong, finding
