"""A capture depends on its camera and its scene: not on what the camera did before, nor on the way it is taken."""

from __future__ import annotations

import random

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from tests.base import BaseTester
from tests.camera.histories import WAYS, draw_history, live


@st.composite
def histories(draw: st.DrawFn) -> object:
    return draw_history(lambda values: draw(st.sampled_from(values)))


class TestHistories(BaseTester):
    @given(history=histories())
    @settings(max_examples=10)
    def test_property_a_capture_is_that_of_a_new_camera(self, history):
        finding = live(history)
        assert not finding.wrong, finding

    @pytest.mark.parametrize("way", WAYS)
    def test_feature_each_way_after_some_events(self, way):
        chosen = random.Random(way)
        history = draw_history(lambda values: way if way in values else chosen.choice(values))
        finding = live(history)
        assert not finding.wrong, finding
