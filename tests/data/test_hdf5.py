"""HDF5 files of one map, and what their attributes say of its numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.data import read_depth
from tests.base import BaseTester

h5py = pytest.importorskip("h5py")


def saved(folder, stored, **attributes):
    with h5py.File(folder / "depth.h5", "w") as file:
        file.create_dataset("depth", data=stored).attrs.update(attributes)
    return folder / "depth.h5"


class TestDecodeHdf5(BaseTester):
    @pytest.mark.parametrize("name", ["_FillValue", "missing_value"])
    def test_convention_the_missing_value_is_unknown(self, name, tmp_path):
        stored = np.array([[2.0, 1e20, 3.0]], np.float32)
        depth, valid = read_depth(saved(tmp_path, stored, **{name: stored[0, 1]}))
        assert valid.flatten().tolist() == [True, False, True]
        self.assert_close(depth, torch.tensor([[[2.0, 2.0, 3.0]]]))

    @pytest.mark.parametrize(
        ("attributes", "scale"),
        [
            ({"scale_factor": 0.001, "units": "m"}, 0.001),
            ({"units": b"millimeters"}, 0.001),
            ({"scale_factor": np.array([0.5]), "units": "cm"}, 0.005),
        ],
    )
    def test_convention_a_factor_is_told_and_not_applied(self, attributes, scale, tmp_path):
        path = saved(tmp_path, np.array([[500, 2000]], np.uint16), **attributes)
        self.assert_close(read_depth(path, scale).depth, scale * torch.tensor([[[500.0, 2000.0]]]))
        with pytest.warns(UserWarning, match=f"multiplied by {scale:g}, and scale is 1: if that gives metres"):
            read_depth(path)

    def test_exception_an_offset(self, tmp_path):
        with pytest.raises(ValueError, match="to be changed by add_offset 5: save the depths"):
            read_depth(saved(tmp_path, np.ones((2, 3), np.uint16), add_offset=5.0), 0.001)

    def test_feature_attributes_of_other_kinds_say_nothing(self, tmp_path):
        given = {"scale_factor": "two", "_FillValue": np.zeros(3), "units": 7, "add_offset": np.zeros(0)}
        self.assert_close(read_depth(saved(tmp_path, np.full((2, 3), 2.0), **given)).depth, torch.full((1, 2, 3), 2.0))
