"""HDF5 files of one map, and what their attributes say of its numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.data import read_depth, read_image
from tests.base import BaseTester

h5py = pytest.importorskip("h5py")


def saved(folder, stored, **attributes):
    with h5py.File(folder / "depth.h5", "w") as file:
        file.create_dataset("depth", data=stored).attrs.update(attributes)
    return folder / "depth.h5"


class TestDecodeHdf5(BaseTester):
    @pytest.mark.parametrize(
        "attributes",
        [{"_FillValue": np.float32(1e20)}, {"missing_value": np.array([-1, 1e20], np.float32)}, {"valid_max": 100.0},
         {"valid_range": np.array([0, 100], np.int16)}],
    )  # fmt: skip
    @pytest.mark.parametrize("order", "<>")
    def test_convention_the_missing_value_is_unknown(self, attributes, order, tmp_path):
        stored = np.array([[2.0, 1e20, 3.0]], f"{order}f4")
        depth, valid = read_depth(saved(tmp_path, stored, **attributes))
        assert valid.flatten().tolist() == [True, False, True]
        self.assert_close(depth, torch.tensor([[[2.0, 2.0, 3.0]]]))

    def test_convention_of_netcdf_axes_and_unsigned_numbers(self, tmp_path):
        stored, given = np.array([[-2, -1, 7]], np.int16), {"_Unsigned": "true", "_FillValue": np.int16(-1)}
        path = saved(tmp_path, stored, **given, valid_range=np.array([1, -1], np.int16))
        with h5py.File(path, "a") as file:
            file["x"] = np.arange(3.0)
            file["x"].make_scale("x")
            file["depth"].dims[1].attach_scale(file["x"])
        self.assert_close(read_depth(path).depth, torch.tensor([[[65534.0, 65534.0, 7.0]]]))
        (tmp_path / "a.h5").write_bytes(saved(tmp_path, np.array([[0, 65535]], ">u2")).read_bytes())
        self.assert_close(read_image(tmp_path / "a.h5"), torch.tensor([[[0.0, 1.0]]]))

    @pytest.mark.parametrize(
        ("attributes", "scale"),
        [
            ({"scale_factor": 0.001, "units": "m"}, 0.001),
            ({"units": b"millimeters"}, 0.001),
            ({"scale_factor": np.array([0.5]), "units": "cm"}, 0.005),
            ({"Units": np.array([b"mm"])}, 0.001),
            ({"unit": np.array(["Feet"], h5py.string_dtype())}, 0.3048),
        ],
    )
    def test_convention_a_factor_is_told_and_not_applied(self, attributes, scale, tmp_path):
        path = saved(tmp_path, np.array([[500, 2000]], np.uint16), **attributes)
        self.assert_close(read_depth(path, scale).depth, scale * torch.tensor([[[500.0, 2000.0]]]))
        with pytest.warns(UserWarning, match=f"multiplied by {scale:g}, and scale is 1: if that gives metres"):
            read_depth(path)

    @pytest.mark.parametrize(
        ("attributes", "sentence"),
        [({"add_offset": 5.0}, "add_offset .5.0.: save the"), ({"add_offset": [0, 2.0]}, "add_offset .0.0, 2.0.:"),
         ({"scale_factor": "two"}, "scale_factor .'two'.: save"), ({"scale_factor": -1.0}, "scale_factor .-1.0.: save"),
         ({"units": "m^-1"}, "numbers are inverse depth by their unit, 'm.-1': save 1 / depth")],
    )  # fmt: skip
    def test_exception_numbers_that_are_to_be_changed(self, attributes, sentence, tmp_path):
        with pytest.raises(ValueError, match=sentence):
            read_depth(saved(tmp_path, np.ones((2, 3), np.uint16), **attributes), 0.001)

    def test_feature_attributes_of_other_kinds_say_nothing(self, tmp_path):
        given = {"_FillValue": "two", "units": 7, "add_offset": np.zeros(0), "unit": h5py.Empty("S1")}
        self.assert_close(read_depth(saved(tmp_path, np.full((2, 3), 2.0), **given)).depth, torch.full((1, 2, 3), 2.0))
