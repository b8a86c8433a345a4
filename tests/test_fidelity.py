from __future__ import annotations

import pytest

from kornia_tidy import Fidelity
from tests.base import BaseTester


class TestFidelity(BaseTester):
    @pytest.mark.parametrize("name", ["paper", "draft", "balanced", "reference"])
    def test_smoke_presets(self, name):
        assert Fidelity.preset(name).name == name

    def test_feature_a_changed_preset_says_so(self):
        changed = Fidelity.preset("draft").replace(layers="linear").replace(window=9)
        assert (changed.name, changed.layers, changed.window) == ("draft, changed", "linear", 9)

    def test_exception_a_choice_of_thousands_of_letters_is_cut(self):
        with pytest.raises(ValueError, match="must be one of") as told:
            Fidelity.preset("a" * 5000)
        assert len(str(told.value)) < 200

    def test_exception_unknown_preset_lists_them(self):
        with pytest.raises(ValueError, match="'paper', 'draft', 'balanced', 'reference', got 'best'"):
            Fidelity.preset("best")

    @pytest.mark.parametrize(
        ("knob", "value"),
        [
            ("propagation", "fast"),
            ("layers", "quadratic"),
            ("stray_light", "keep"),
            ("occlusion_states", "first"),
            ("pixel_tolerance", 0.0),
            ("layer_spacing", -1.0),
            ("enclosed_energy", 1.0),
            ("wavelengths", 0),
            ("wavelengths", 2.5),
            ("correlate", "no"),
            ("window", 22),
            ("max_window", 0),
            ("window", 100001),
            ("max_window", 4097),
        ],
    )
    def test_exception_names_knob_and_value(self, knob, value):
        with pytest.raises(ValueError, match=f"{knob} must be .* got {value!r}"):
            Fidelity(**{knob: value})
