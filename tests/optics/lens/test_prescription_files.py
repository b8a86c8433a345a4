"""Files of Zemax, CODE V, Optiland and DeepLens against the prescriptions that they were written from."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from kornia_tidy.optics import Lens
from kornia_tidy.optics.lens import Prescription
from kornia_tidy.optics.lens.codev_file import read_codev
from kornia_tidy.optics.lens.file_surfaces import lens_of
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.glasses import catalogue_glass
from kornia_tidy.optics.lens.json_lenses import read_json_lens
from kornia_tidy.optics.lens.prescription_files import read_prescription_file
from kornia_tidy.optics.lens.zemax_file import read_zemax
from tests.base import BaseTester
from tests.optics.lens.lenses import plano_convex
from tests.optics.lens.written_files import WRITERS, WRITTEN, aspheric, codev, deeplens, doublet, named, optiland, zemax

ASPHERE_WITHOUT_R2 = aspheric()
del ASPHERE_WITHOUT_R2["surfaces"][2]["poly"][2]  # CODE V has no term of r^2


def written(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def assert_same(found: Prescription, expected: Prescription, tolerance: float = 1e-12) -> None:
    assert len(found.surfaces) == len(expected.surfaces)
    assert found.stop == expected.stop
    assert found.image_plane == expected.image_plane
    for a, b in zip(found.surfaces, expected.surfaces, strict=True):
        for part in ("curvature", "conic", "gap", "clear"):
            assert getattr(a, part) == pytest.approx(getattr(b, part), rel=tolerance, abs=1e-15), part
        assert dict(a.powers) == pytest.approx(dict(b.powers), rel=tolerance)
    for wavelength in (470e-9, 530e-9, 610e-9):
        assert found.indices(wavelength) == pytest.approx(expected.indices(wavelength), abs=1e-9)


class TestPrescriptionFiles(BaseTester):
    @pytest.mark.parametrize("kind", WRITERS)
    @pytest.mark.parametrize("lens", WRITTEN)
    def test_feature_a_file_is_the_prescription_it_was_written_from(self, tmp_path, kind, lens):
        given = WRITTEN[lens]()
        if lens == "aspheric" and kind == ".seq":
            given = ASPHERE_WITHOUT_R2
        found, height = read_prescription_file(written(tmp_path, f"a{kind}", WRITERS[kind](given)))
        assert_same(found, Prescription.read(given))
        assert found.name == given["name"]
        length = first_order(found, 8.0, math.inf).focal_length
        assert height == pytest.approx(5e-3 if kind == ".deeplens.json" else length * math.tan(math.radians(6)))

    @pytest.mark.parametrize("unit", ["MM", "CM", "IN", "METER"])
    def test_feature_units_of_zemax(self, unit):
        assert_same(lens_of(read_zemax(zemax(aspheric(), unit)))[0], Prescription.read(aspheric()))

    @pytest.mark.parametrize("unit", ["M", "C", "I"])
    @pytest.mark.parametrize("radii", [True, False])
    def test_feature_units_and_curvatures_of_codev(self, unit, radii):
        found, _ = lens_of(read_codev(codev(ASPHERE_WITHOUT_R2, unit, radii=radii)))
        assert_same(found, Prescription.read(ASPHERE_WITHOUT_R2))

    @pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8", "utf-8-sig", "latin-1"])
    def test_feature_encodings(self, tmp_path, encoding):
        text = zemax(doublet() | {"name": "Achromat \u00b5"})
        found, _ = read_prescription_file(written(tmp_path, "a.ZMX", text.encode(encoding)))
        assert found.name == "Achromat \u00b5"

    def test_feature_a_file_gives_the_lens_of_its_prescription(self, tmp_path):
        path = written(tmp_path, "doublet.zmx", zemax(doublet()))
        given = {"f_number": 8.0, "focus_distance": 2.0, "wavelengths": (530e-9,), "field": 5e-3}
        found, expected = Lens.from_prescription(path, **given), Lens.from_prescription(doublet(), **given)
        assert found.name == "doublet"
        heights, psi = torch.tensor([0.0, 2e-3, 5e-3]), torch.tensor([-10.0, 0.0, 10.0])
        a, b = (lens.sample(heights, psi, 530e-9).wavefront for lens in (found, expected))
        self.assert_close(a, b, rtol=1e-5, atol=1e-5)

    def test_feature_a_sensor_near_focus_keeps_its_distance_from_it(self):
        """In the file from the focus of the d line, in the lens from that of 530 nm, .2 mm apart."""
        given = named("single-50mm")
        found, _ = lens_of(read_zemax(zemax(given, shift=0.3)))
        expected = first_order(Prescription.read(given), 8.0, math.inf).sensor_z + 0.3e-3
        assert found.image_plane == pytest.approx(expected, abs=1e-9)
        far, _ = lens_of(read_zemax(zemax(given, shift=5.0)))
        assert far.image_plane is None

    def test_feature_planes_without_effect_are_left_out(self):
        text = zemax(doublet())
        dummy = "SURF 9\r\n  TYPE STANDARD\r\n  CURV 0.0\r\n  DISZ -1.5\r\n"
        at = text.index("SURF 2\r\n")
        found, _ = lens_of(read_zemax(text[:at] + dummy + text[at:]))
        expected = doublet()
        expected["surfaces"][0]["t"] = 0.5
        assert_same(found, Prescription.read(expected))

    @pytest.mark.parametrize("behind", [False, True])
    def test_feature_a_stop_on_a_surface_is_the_plane_through_its_vertex_in_air(self, behind):
        """Of a plano-convex element: in front of its first surface, or behind its last."""
        given = plano_convex(25.0, 3.0) | {"unit": "mm", "index": {"glass": {"nd": 1.5, "vd": 60.0}}}
        text = zemax(given)
        first, second = text.index("SURF 1\r\n"), text.index("SURF 2\r\n")
        text = text[:first] + text[second:]
        where = text.index("SURF 3\r\n") if behind else text.index("SURF 2\r\n")
        where += len("SURF 2\r\n")
        found, _ = lens_of(read_zemax(text[:where] + "  STOP\r\n" + text[where:]))
        assert found.stop == (2 if behind else 0)
        optics = first_order(found, 8.0, math.inf)
        assert optics.focal_length == pytest.approx(first_order(Prescription.read(given), 8.0, math.inf).focal_length)

    def test_feature_private_glasses_of_codev_have_indices_at_wavelengths(self):
        text = codev(doublet()).replace("SO 0.0", "PRV\n PWL 656 588 486\n 'my' 1.51 1.52 1.53\nEND\nSO 0.0")
        found, _ = lens_of(read_codev(text.replace("NBK7_SCHOTT", "'MY'")))
        assert found.indices(588e-9)[1] == pytest.approx(1.52)

    @pytest.mark.parametrize(
        ("name", "makers", "index"),
        [
            ("N-BK7", (), 1.51680),
            ("nbk7_schott", (), 1.51680),
            ("BK7", ["SCHOTT"], 1.51680),
            ("N-SF6HT", (), 1.80518),
            ("S-LAL14", ["OHARA"], 1.69680),
            ("J-LAK14", ["SCHOTT", "HIKARI"], 1.69680),
            ("H-K9L", ["CDGM"], 1.51680),
            ("SK16", ["HIKARI"], 1.62041),
            ("PMMA", ["MISC"], 1.491),
            ("ACRYLIC", ["SCHOTT"], 1.491),
            ("F_SILICA", (), 1.45846),
        ],
    )
    def test_feature_catalogue_glasses_have_the_index_of_their_data_sheet(self, name, makers, index):
        lens = Prescription.read(plano_convex(index=catalogue_glass(name, makers)))
        assert lens.indices(587.5618e-9)[1] == pytest.approx(index, abs=2e-5 if index != 1.491 else 1e-3)

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("MODE SEQ", "MODE NSC", "its MODE must be SEQ, for surfaces in sequence, got 'NSC'"),
            ("UNIT MM", "UNIT FEET", "its UNIT must be one of MM, CM, IN, INCH, METER, M, got 'FEET'"),
            ("TYPE STANDARD\r\n  CURV 0.0", "TYPE COORDBRK\r\n  CURV 0.0", "surface 0 must be of type .*'COORDBRK'"),
            ("GLAS N-BK7", "GLAS UNKNOWN7", "surface 2: the glass 'UNKNOWN7' of SCHOTT, MISC is not known"),
            ("GLAS N-BK7 0 0", "GLAS MIRROR 0 0", "surface 2 is a mirror"),
            ("GCAT SCHOTT", "GCAT CDGM", "the glass 'N-BK7' of CDGM, MISC is not known"),
            ("  STOP\r\n", "", "it must have one stop, got none"),
            ("  HIDE 0 0 0\r\n", "  STOP\r\n", "it must have one stop, got surface 1, surface 2"),
            ("DISZ 2.0", "DISZ", "DISZ of surface 1 must be a finite number, got ''"),
            ("DISZ 2.0", "DISZ INFINITY", "distances between its surfaces must be finite"),
            ("DISZ 6.0", "DISZ -6.0", "the distance behind surface 2 must not be negative, got -6"),
            ("DISZ 6.0", "DISZ nan", "DISZ of surface 2 must be a finite number, got 'nan'"),
            ("DIAM 12.0", "SQAP 3 3\r\n  DIAM 12.0", "surface 2 has 'SQAP', which is not read"),
            ("DIAM 12.0", "OBDC 0 1.5\r\n  DIAM 12.0", "surface 2 must stand about the axis, got OBDC 0 1.5"),
            ("DIAM 12.0", "CLAP 1 12\r\n  DIAM 12.0", "aperture of surface 2 must be a disc, got CLAP 1 12"),
            ("DIAM 12.0", "XDAT 1 4.0\r\n  DIAM 12.0", "surface 2 has extra data"),
        ],
    )  # fmt: skip
    def test_exception_zemax_names_what_it_does_not_read(self, tmp_path, old, new, message):
        text = zemax(doublet())
        assert old in text
        path = written(tmp_path, "a.zmx", text.replace(old, new))
        with pytest.raises(ValueError, match=message) as raised:
            read_prescription_file(path)
        assert str(path) in str(raised.value)
        assert "\n" not in str(raised.value)

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("RDM;LEN", "LEN", "it must say by RDM"),
            ("DIM M", "DIM F", "its DIM must be one of M, MM, C, CM, I, IN, got 'F'"),
            ("  STO\n", "  STO\n  ADE 5\n", "surface 1 has the command 'ADE', which is not read"),
            ("  STO\n", "  STO\n  CIR OBS 1\n", "aperture of surface 1 must be a disc, got CIR OBS 1"),
            ("  STO\n", "", "it must have one stop, got none"),
            ("  STO\n", "  STO S9\n", "its stop must be one of the surfaces 1 to 4, got 9"),
            ("NBK7_SCHOTT", "REFL", "surface 2 is a mirror"),
            ("NBK7_SCHOTT", "XYZ", "surface 2: the glass 'XYZ' is not known"),
            ("REF 2", "REF 7", "its REF must be from 1 to 3, got 7"),
            ("SI 0.0 0.0", "", "it must have an object"),
            ("S 61.47 6.0", "S 61.47", "distance behind surface 2 must be a finite number, got 'NBK7_SCHOTT'"),
            ("GO", "ZOO 3", "it has the command 'ZOO'"),
        ],
    )
    def test_exception_codev_names_what_it_does_not_read(self, tmp_path, old, new, message):
        text = codev(doublet())
        assert old in text
        with pytest.raises(ValueError, match=message) as raised:
            read_prescription_file(written(tmp_path, "a.seq", text.replace(old, new)))
        assert "\n" not in str(raised.value)

    @pytest.mark.parametrize(
        ("write", "old", "new", "message"),
        [
            (optiland, '"StandardGeometry"', '"Biconic"', "surface 2 must be one of Plane, .*, got 'Biconic'"),
            (optiland, '"rx": 0.0', '"rx": 0.1', "surface 0 must stand on the axis, upright, got rx=0.1"),
            (optiland, '"is_reflective": false', '"is_reflective": true', "surface 0 is a mirror"),
            (optiland, '"Material"', '"MaterialFile"', "glass of surface 2 must be Material.*'MaterialFile'"),
            (optiland, '"surfaces"', '"rows"', "surfaces of surface_group must be a list, got None"),
            (deeplens, '"Spheric"', '"Diffractive"', "type of surface 1 must be one of .*, got 'Diffractive'"),
            (deeplens, '"n-bk7"', '"okp4"', "surface 1: the glass 'okp4' is not known"),
            (deeplens, '"d_next": 6.0', '"d_next": null', "d_next of surface 1 must be a finite number, got None"),
        ],
    )
    def test_exception_json_names_what_it_does_not_read(self, tmp_path, write, old, new, message):
        text = write(doublet())
        assert old in text
        with pytest.raises(ValueError, match=message):
            read_prescription_file(written(tmp_path, "a.json", text.replace(old, new)))

    @pytest.mark.parametrize(
        ("name", "data", "message"),
        [
            ("a.txt", b"x", "must be a file .zmx, .seq, .json, got"),
            ("a.zmx", b"\xff\xfe\x00", "it is no text in utf-16"),
            ("a.zmx", b"\x89PNG\r\n\x1a\n\x00\x00", "it must have an object, surfaces and a sensor, got 0"),
            ("a.seq", b"\x89PNG", "has the command"),
            ("a.json", b"[1, 2]", "prescription must be a mapping"),
            ("a.json", b"{", "Expecting property name"),
            ("a.json", b"{}", "surfaces of the prescription must be a list"),
        ],
    )
    def test_exception_files_that_are_no_lens(self, tmp_path, name, data, message):
        with pytest.raises(ValueError, match=message):
            read_prescription_file(written(tmp_path, name, data))

    def test_exception_a_file_without_fields_wants_one(self, tmp_path):
        path = written(tmp_path, "a.zmx", zemax(doublet()).replace("YFLN 0 3.0 6.0", "YFLN 0 0 0"))
        with pytest.raises(ValueError, match="field must be the largest height on the sensor in metres, got None"):
            Lens.from_prescription(path, 8.0, 2.0)

    def test_smoke_json_of_our_own_keys_has_its_field(self, tmp_path):
        given = plano_convex(25.0, 3.0) | {"pitch_um": 8.0, "sensor": [1110, 1282]}
        found, height = read_prescription_file(written(tmp_path, "a.json", json.dumps(given)))
        assert_same(found, Prescription.read(given))
        assert height == pytest.approx(6.783e-3, abs=1e-6)

    def test_smoke_json_of_others_is_left_to_others(self):
        assert read_json_lens({"surfaces": [{"R": 1.0}]}) is None
        assert read_json_lens([1]) is None
