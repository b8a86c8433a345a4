from __future__ import annotations

import dataclasses
import re
from fractions import Fraction

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kornia_tidy.cli.app.settings import CONTROLS, Settings, by_name, settings_of, shown
from tests.base import BaseTester

UNITS = ("(m)", "(mm)", "(µm)", "(% of full scale)", "(%)", "(pixels)")
UNITED = [control for control in CONTROLS if control.per_unit]
WITHOUT_UNIT = {"f_number", "masks", "seed", "mask_seed", "noise_seed"}


class TestSettings(BaseTester):
    def test_smoke_the_default_is_allowed(self):
        assert Settings() == settings_of({})

    @pytest.mark.parametrize(
        ("values", "sentence"),
        [
            ({"camera": "joint-9"}, "Camera must be one of"),
            ({"scene": "lenna"}, "Scene must be one of"),
            ({"compositing": "sum"}, "Compositing at depth edges must be one of"),
            ({"noise": 0.6}, "Read noise (% of full scale): give a number from 0 to 5, got 60"),
            ({"side": 5000}, "Longer side of the picture (pixels): give a number from 96 to 768, got 5000"),
            ({"seed": -1}, "Number of the painted scene: give a number from 0 to 2147483647, got -1"),
            ({"near": 4.0, "far": 2.0}, "the nearest depth must be positive and below the farthest, got 4 m and 2 m"),
            ({"scene": "files"}, "a photo is missing: upload both"),
            ({"lens": "single"}, "Lens must be one of 'ideal', 'double-gauss-50mm'"),
            ({"place": 1.5}, "Place of the picture in a real lens's field (%): give a number from 0 to 100, got 150"),
            ({"camera": "own", "masks": 0}, "Masks in one exposure, K: give a number from 1 to 16, got 0"),
            ({"camera": "own", "start": "focal sweep", "masks": 7}, "'focal sweep' are 5 at most, got K = 7"),
        ],
    )
    def test_exception_names_the_value_and_what_is_allowed(self, values, sentence):
        with pytest.raises(ValueError, match=re.escape(sentence)):
            Settings(**values)

    def test_exception_a_file_that_is_gone_is_named_without_its_folder(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"^there is no file photo\.png: upload it again$"):
            Settings(scene="files", image_file=str(tmp_path / "photo.png"), depth_file="depth.png")


class TestControls(BaseTester):
    def test_feature_each_setting_has_one_control(self):
        assert sorted(control.name for control in CONTROLS) == sorted(f.name for f in dataclasses.fields(Settings))

    def test_feature_what_the_controls_show_at_first_is_the_default(self):
        values = {control.name: control.value for control in CONTROLS}
        assert settings_of(values) == Settings()

    def test_feature_each_number_with_a_unit_has_it_in_its_label(self):
        numbers = [c for c in CONTROLS if c.kind in {"number", "slider", "whole"} and c.name not in WITHOUT_UNIT]
        assert len(numbers) == 8
        assert [c.label for c in numbers if not c.label.endswith(UNITS)] == []

    @pytest.mark.parametrize("text", ["1e-5", "1E-5", ".00001", "0.00001", "0,00001", " 1e-05 ", "10e-6", 1e-5])
    def test_feature_a_number_is_read_however_it_is_written(self, text):
        assert settings_of({"noise": text}).noise == 1e-7

    @settings(max_examples=300, deadline=None)
    @given(number=st.floats(allow_nan=False, allow_infinity=False), name=st.sampled_from([c.name for c in UNITED]))
    @example(number=-0.0, name="noise")
    @example(number=5e-324, name="focal_length")
    @example(number=1.7976931348623157e308, name="pixel_pitch")
    def test_property_any_number_is_scaled_exactly_and_rounded_once(self, number, name):
        """Against fractions, which are exact: the float nearest to the decimal that Python writes."""
        control = by_name(name)
        exact = Fraction(repr(number)) * Fraction(10) ** control.per_unit
        for typed in (number, repr(number)):
            assert control.setting(typed) == float(exact)

    @pytest.mark.parametrize(
        "typed", ["", "x", "1e", "1,000.5", "nan", "inf", float("nan"), float("inf"), "1e400", True]
    )
    @pytest.mark.parametrize("name", ["noise", "seed"])
    def test_exception_no_number(self, typed, name):
        with pytest.raises(ValueError, match=rf"^{re.escape(by_name(name).label)}: give a number, got "):
            by_name(name).setting(typed)

    def test_exception_a_part_of_a_whole_number(self):
        with pytest.raises(ValueError, match=r"Number of the painted scene: give a whole number, got 2\.5"):
            settings_of({"seed": 2.5})

    def test_feature_defaults_lie_in_the_range_of_their_controls(self):
        limited = [c for c in CONTROLS if c.low is not None and c.high is not None]
        assert [c.name for c in limited if not c.low <= c.value <= c.high] == []
        chosen = [c for c in CONTROLS if c.kind == "choice"]
        assert [c.name for c in chosen if c.value not in [value for _, value in c.choices]] == []

    def test_exception_an_empty_number(self):
        with pytest.raises(ValueError, match=r"^Focus distance \(m\): give a number$"):
            settings_of({"focus_distance": None})

    @pytest.mark.parametrize(
        ("group", "scene", "camera", "stretch", "expected"),
        [
            ("own camera", "dead leaves", "edof-5", True, False),
            ("own camera", "files", "own", True, True),
            ("painted depths", "dead leaves", "edof-5", True, False),
            ("painted depths", "dead leaves", "edof-5", False, True),
            ("painted depths", "photographic leaves", "own", True, True),
            ("painted depths", "files", "own", True, False),
            ("painted scene", "files", "own", True, False),
            ("files", "files", "edof-5", True, True),
            ("camera", "files", "own", False, True),
        ],
    )
    def test_feature_controls_without_effect_are_hidden(self, group, scene, camera, stretch, expected):
        assert shown(group, scene, camera, stretch) is expected
