from __future__ import annotations

import copy

import pytest

from kornia_tidy.optics.lens import NAMED_LENSES, Prescription
from tests.base import BaseTester
from tests.optics.lens.lenses import plano_convex, symmetric_pair


def changed(path: tuple[object, ...], value: object) -> dict[str, object]:
    given = copy.deepcopy(symmetric_pair())
    place: object = given
    for key in path[:-1]:
        place = place[key]  # type: ignore[index]
    place[path[-1]] = value  # type: ignore[index]
    return given


class TestPrescription(BaseTester):
    def test_feature_millimetres_and_metres_are_the_same_lens(self):
        metres = plano_convex()
        metres["surfaces"][1]["poly"] = {4: 50.0, "6": -2e5}
        millimetres = copy.deepcopy(metres) | {"unit": "mm"}
        for surface in millimetres["surfaces"]:
            surface["t"] *= 1e3
            surface["R"] = surface.get("R") and surface["R"] * 1e3
        millimetres["surfaces"][1]["poly"] = {4: 50.0e-9, "6": -2e5 * 1e-15}
        one, other = Prescription.read(metres), Prescription.read(millimetres)
        for a, b in zip(one.surfaces, other.surfaces, strict=True):
            assert a.curvature == pytest.approx(b.curvature)
            assert a.gap == pytest.approx(b.gap)
            assert dict(a.powers) == pytest.approx(dict(b.powers))

    def test_feature_a_table_with_pixels_in_micrometres_is_in_millimetres(self):
        given = plano_convex(25.0, 3.0) | {"pitch_um": 8.0, "sensor": [1110, 1282], "fnumbers": [8], "focus": 595.0}
        assert Prescription.read(given).surfaces[1].curvature == pytest.approx(40.0)

    @pytest.mark.parametrize(
        ("index", "wavelength", "expected"),
        [
            (1.5, 400e-9, 1.5),
            ({"530": 1.6}, 530e-9, 1.6),
            ({"470": 1.53, "610": 1.51}, 470e-9, 1.53),
            ({"nd": 1.5168, "vd": 64.17}, 587.5618e-9, 1.5168),
            ({"sellmeier": [[1.03961212, 0.00600069867], [0.231792344, 0.0200179144], [1.01046945, 103.560653]]},
             587.5618e-9, 1.51680),
        ],
    )  # fmt: skip
    def test_feature_indices_in_every_form(self, index, wavelength, expected):
        """The last: N-BK7 by Schott's data sheet."""
        lens = Prescription.read(plano_convex(index=index))
        assert lens.indices(wavelength) == pytest.approx([1.0, expected, 1.0], abs=5e-6)

    def test_feature_abbe_numbers_are_kept(self):
        blue, line, red = (
            Prescription.read(plano_convex(index={"nd": 1.5168, "vd": 64.17})).indices(wave)[1]
            for wave in (486.1327e-9, 587.5618e-9, 656.2725e-9)
        )
        assert (line - 1) / (blue - red) == pytest.approx(64.17)

    @pytest.mark.parametrize("name", NAMED_LENSES)
    def test_smoke_named_lenses_are_read_and_have_a_source(self, name):
        lens = Prescription.read(NAMED_LENSES[name]["prescription"])
        assert lens.name == name
        assert len(lens.source) > 20

    @pytest.mark.parametrize(
        ("given", "error", "message"),
        [
            (5, TypeError, "prescription must be a mapping, got the number 5"),
            ({}, TypeError, "surfaces of the prescription must be a list of mappings, got None"),
            ({"surfaces": []}, ValueError, "must be 2 to 200 with the stop, got 0"),
            (changed(("lens",), 3), ValueError, "must have the keys .*, got 'lens'"),
            (changed(("unit",), "inch"), ValueError, "unit of the prescription must be one of 'm', 'mm', got 'inch'"),
            (changed(("surfaces", 0), 7), TypeError, "surface 0 must be a mapping, got the number 7"),
            (changed(("surfaces", 0, "radius"), 7), ValueError, "surface 0 must have the keys .*, got 'radius'"),
            (changed(("surfaces", 0, "R"), 0), ValueError, "R of surface 0 must be finite and not 0, got 0"),
            (changed(("surfaces", 0, "R"), "big"), TypeError, "R of surface 0 must be a number, got 'big'"),
            (changed(("surfaces", 0, "t"), -1e-3), ValueError, "t of surface 0 must not be negative, got -0.001"),
            (changed(("surfaces", 0, "t"), 50.0), ValueError, "at most 10 m long, got .* m: .* give it 'unit': 'mm'"),
            (changed(("surfaces", 0, "k"), float("nan")), ValueError, "k of surface 0 must be finite, got nan"),
            (changed(("surfaces", 0, "poly"), {1: 1.0}), ValueError, "of surface 0 must be from 2 to 30, got 1"),
            (changed(("surfaces", 0, "poly"), {"a": 1.0}), TypeError, "of surface 0 must be whole numbers, got 'a'"),
            (changed(("surfaces", 0, "poly"), {4: 1, "4": 1}), ValueError, "must have each power once, got 4, 4"),
            (changed(("surfaces", 0, "glass"), "flint"), ValueError, "must have the glass 'flint', got glass"),
            (changed(("surfaces", 0, "glass"), None), TypeError, "glass of surface 0 must be a name, got None"),
            (changed(("surfaces", 0, "r"), 0.0), ValueError, "r of surface 0 must be at least 1e-05 m or None, got 0"),
            (changed(("surfaces", 0, "kind"), "mirror"), ValueError, "must be one of 'surface', 'stop', got 'mirror'"),
            (changed(("surfaces", 0, "kind"), "stop"), ValueError, "is the stop and must be a plane, got R=0.04"),
            (changed(("surfaces", 2), {"t": 6e-3}), ValueError, "must have one of kind 'stop', got 0"),
            (changed(("surfaces", 4, "glass"), "glass"), ValueError, "must have air behind it, got 'glass'"),
            (changed(("surfaces", 2, "glass"), "glass"), ValueError, "the medium before it behind it, got 'glass'"),
            (changed(("index", "glass"), 0.9), ValueError, "index of 'glass' must be above 1 and below 5, got 0.9"),
            (changed(("index", "glass"), {}), ValueError, "must be known at one wavelength or more, got none"),
            (changed(("index", "glass"), {"red": 1.5}), ValueError, "of 100 to 20000 nm, got 'red'"),
            (changed(("index", "glass"), {"sellmeier": 1}), ValueError, "must have pairs of numbers"),
            (changed(("name",), 5), TypeError, "name of the prescription must be a text, got the number 5"),
        ],
    )  # fmt: skip
    def test_exception_one_sentence_for_each_mistake(self, given, error, message):
        with pytest.raises(error, match=message) as raised:
            Prescription.read(given)
        assert "\n" not in str(raised.value)
