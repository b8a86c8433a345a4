from __future__ import annotations

from dataclasses import fields

import pytest

from kornia_tidy import Fidelity
from kornia_tidy.design.tradeoff import SWEEP_VALUES, sweep_settings
from kornia_tidy.fidelity import PRESETS
from tests.base import BaseTester


def differences(a, b):
    return {f.name for f in fields(Fidelity) if f.name != "name" and getattr(a, f.name) != getattr(b, f.name)}


class TestSweepSettings(BaseTester):
    @pytest.mark.parametrize("base", sorted(PRESETS))
    def test_feature_each_knob_is_turned_alone(self, base):
        for setting in sweep_settings(base):
            if setting.knob != "preset":
                assert getattr(setting.fidelity, setting.knob) == setting.value
                also = {"max_window"} if setting.knob == "enclosed_energy" else set()
                assert differences(setting.fidelity, PRESETS[base]) <= {setting.knob} | also

    @pytest.mark.parametrize("base", sorted(PRESETS))
    def test_feature_the_base_is_a_value_of_every_sweep(self, base):
        settings = sweep_settings(base)
        for knob in SWEEP_VALUES:
            assert [s.fidelity for s in settings if s.knob == knob].count(PRESETS[base]) == 1

    def test_feature_a_setting_of_ones_own_is_a_base_too(self):
        base = Fidelity("mine", window=21)
        assert [s.value for s in sweep_settings(base, ["window"])] == [9, 17, 33, 65, 129, 257, 21]

    def test_exception_names_the_knobs(self):
        with pytest.raises(ValueError, match=r"knob must be one of 'preset', 'layers', .* got 'speed'"):
            sweep_settings(knobs=["speed"])
