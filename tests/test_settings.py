from __future__ import annotations

import re
from dataclasses import dataclass
from math import inf, nan
from typing import Annotated

import pytest

from kornia_tidy.settings import (
    Count,
    DepthRange,
    Distance,
    Metres,
    Unit,
    check_settings,
    documented,
    one_of,
    plain,
    settings_of,
)
from tests.base import BaseTester


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Lens and sensor.

    A paragraph.

    Args:
        pitch: of the sensor, see :class:`~kornia_tidy.TiDyOptics`.
        focus: that is seen sharply. None: the
            middle of 1.5 m. May be infinite.
    """

    pitch: Metres = 8e-6
    focus: Distance | None = None


@dataclass(frozen=True, kw_only=True)
class Camera(Lens):
    """Camera.

    Args:
        depths: nearest and farthest.
        kind: of it.
        weights: some numbers.
        focus: of the camera. None: 2 m.
    """

    depths: DepthRange | None = None
    kind: Annotated[str, one_of({"wide": "sees much", "long": "sees far"})] = "wide"
    weights: tuple[Count, ...] = ()
    name: Annotated[str, one_of(("a",), others=True)] = "a"
    own: bool = False

    def __post_init__(self) -> None:
        check_settings(self)


class TestSettingsOf(BaseTester):
    def test_feature_each_is_described_by_its_field_and_docstring(self):
        found = {setting.name: setting for setting in settings_of(Camera)}
        assert list(found) == ["pitch", "focus", "depths", "kind", "weights", "name", "own"]
        assert found["pitch"].purpose == "of the sensor"
        assert (found["pitch"].kind, found["pitch"].unit.name, found["pitch"].group) == (float, "metres", Lens)
        assert (found["focus"].purpose, found["focus"].unset, found["focus"].optional) == ("of the camera", "2 m", True)
        assert (found["depths"].kind, found["depths"].items, found["depths"].unit.symbol) == (float, 2, "NEAR FAR")
        assert (found["weights"].kind, found["weights"].items, found["weights"].unit.symbol) == (int, 0, "N")
        assert found["kind"].unit.words == ("sees much", "sees far")
        (_, focus) = settings_of(Lens)
        assert (focus.purpose, focus.unset) == ("that is seen sharply. May be infinite", "the middle of 1.5 m")

    def test_feature_text_of_a_docstring(self):
        assert documented(Lens)[:2] == ("Lens and sensor.", "A paragraph.")
        assert plain("``'a'`` of :data:`x.Y`") == "'a' of Y"


class TestCheckSettings(BaseTester):
    @pytest.mark.parametrize(
        "allowed",
        [
            {"focus": inf},
            {"focus": None},
            {"pitch": 1},
            {"depths": [0.5, inf]},
            {"weights": (1, 10**400)},
            {"name": "anything"},
        ],
    )
    def test_feature_allowed(self, allowed):
        Camera(**allowed)

    @pytest.mark.parametrize(
        ("wrong", "sentence"),
        [
            ({"pitch": 0.0}, "pitch must be a number of metres above 0, got 0.0"),
            ({"pitch": inf}, "pitch must be a number of metres above 0, got inf"),
            ({"pitch": nan}, "pitch must be a number of metres above 0, got nan"),
            ({"pitch": True}, "pitch must be a number of metres above 0, got True"),
            ({"pitch": "8"}, "pitch must be a number of metres above 0, got '8'"),
            ({"pitch": 10**400}, "pitch must be a number of metres above 0, got 1000"),
            ({"pitch": None}, "pitch must be a number of metres above 0, got None"),
            ({"focus": -inf}, "focus must be a number of metres above 0, got -inf"),
            ({"depths": (1.0,)}, "depths must be two values, got (1.0,)"),
            ({"depths": (1.0, -1.0)}, "depths must be a number of metres above 0, got -1.0"),
            ({"depths": 1.0}, "depths must be two values, got 1.0"),
            ({"weights": 1}, "weights must be some values, got 1"),
            ({"weights": (1.5,)}, "weights must be a whole number of at least 1, got 1.5"),
            ({"kind": "macro"}, "kind must be one of 'wide', 'long', got 'macro'"),
            ({"name": 3}, "name must be one of 'a', got 3"),
            ({"own": 1}, "own must be true or false, got 1"),
        ],
    )
    def test_exception_names_the_value_and_what_is_allowed(self, wrong, sentence):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}.{{,100}}$"):
            Camera(**wrong)

    @pytest.mark.parametrize(
        ("unit", "sentence"),
        [
            (Unit("N", "", 2, 5), "must be a whole number from 2 to 5, got 6"),
            (Unit("N", "", 7), "must be a whole number of at least 7, got 6"),
            (Unit("N", "pixels", most=5), "must be a whole number of pixels"),
        ],
    )
    def test_exception_ranges(self, unit, sentence):
        assert unit.complaint(6, int).startswith(sentence)
