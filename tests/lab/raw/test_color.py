"""Colours of cameras against colour-science and spectra."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.raw.color import SRGB_FROM_XYZ, camera_to_srgb
from tests.base import BaseTester

with warnings.catch_warnings(), np.printoptions():  # importing colour sets NumPy's print options
    warnings.simplefilter("ignore")
    import colour

# Canon PowerShot G2 and G1 (four colours), as LibRaw tells them.
G2 = ((0.9194, -0.2787, -0.1059), (-0.8098, 1.5657, 0.2608), (-0.2610, 0.3064, 0.7867))
G1 = ((-0.5686, 1.0300, 0.2223), (0.4725, -0.1157, 0.4383), (-0.6128, 1.0783, 0.6163), (-0.2688, 1.2093, 0.0604))
D65 = (0.95047, 1.0, 1.08883)


def tensor(rows):
    return torch.tensor(rows, dtype=torch.float64)


class TestCameraToSrgb(BaseTester):
    @pytest.mark.parametrize("xyz_to_camera", [G2, G1])
    @given(colors=st.lists(st.floats(0, 1), min_size=3, max_size=3))
    @settings(max_examples=30)
    def test_feature_colours_that_a_camera_sees_come_back(self, xyz_to_camera, colors):
        """sRGB to XYZ by colour-science, to the camera by its matrix, balanced, and back: to that space's 4 digits."""
        xyz = colour.RGB_to_XYZ(colors, "sRGB", apply_cctf_decoding=False)
        matrix, daylight = camera_to_srgb(tensor(xyz_to_camera))
        balanced = tensor(xyz_to_camera) @ torch.as_tensor(xyz) * daylight
        self.assert_close(matrix @ balanced, tensor(colors), atol=2e-3)

    def test_feature_daylight_of_a_known_camera(self):
        """LibRaw's daylight factors of the PowerShot G2: 2.0840, 0.9259, 1.0930."""
        matrix, daylight = camera_to_srgb(tensor(G2))
        self.assert_close(daylight, tensor([2.0840, 0.9259, 1.0930]), atol=1e-4)
        self.assert_close(matrix.sum(1), torch.ones(3), atol=1e-12)

    def test_exception_channel_blind_to_white(self):
        with pytest.raises(ValueError, match="must respond to white in every channel, got"):
            camera_to_srgb(-tensor(G2))

    def test_convention_constants_are_those_of_srgb(self):
        primaries = colour.RGB_COLOURSPACES["sRGB"].copy()
        primaries.use_derived_matrix_XYZ_to_RGB = True
        assert np.abs(primaries.matrix_XYZ_to_RGB - np.array(SRGB_FROM_XYZ)).max() < 1.1e-3  # its white has 4 digits
        assert np.abs(np.array(SRGB_FROM_XYZ) @ D65 - 1).max() < 1e-6
