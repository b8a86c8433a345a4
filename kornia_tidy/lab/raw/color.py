"""Colour conversion from a camera's channels to linear sRGB, and white balance for daylight."""

from __future__ import annotations

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.search_path import import_installed

# Linear sRGB from CIE XYZ with white (D65) at Y = 1, from the primaries of IEC 61966-2-1. XYZ from sRGB is its inverse.
SRGB_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
ASSUMED_CAMERA = "Nikon 5100 (NPL)"  # as colour-science names its measured sensitivities


def camera_to_srgb(xyz_to_camera: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return a camera's matrix from balanced colours to linear sRGB, and its white balance factors for daylight.

    The columns of a matrix B are the camera's responses to the sRGB primaries. Each row is divided by its sum, so that
    sRGB's white gives 1 in every channel. Linear sRGB is then :math:`B^+ c`, with the inverse of B for three filters
    and the least-squares inverse for four.

    Args:
        xyz_to_camera: (n, 3) for n = 3 or 4 filters.

    Returns:
        The matrix (3, n), whose rows sum to 1, and the factors (n,) that make sRGB's white (D65) equal in all channels.

    Convention:
        White balance scales the channels of the camera, as in LibRaw and dcraw.

    Example:
        >>> matrix, daylight = camera_to_srgb(torch.tensor([[0.9, -0.3, -0.1], [-0.8, 1.6, 0.3], [-0.3, 0.3, 0.8]]))
        >>> matrix.sum(1).round(decimals=4), daylight
        (tensor([1., 1., 1.]), tensor([2.2394, 0.8574, 1.1288]))
    """
    srgb_to_camera = xyz_to_camera.double() @ srgb_from_xyz().inverse()
    sums = srgb_to_camera.sum(1, keepdim=True)
    if not bool((sums > 0).all()):
        raise ValueError(f"xyz_to_camera must respond to white in every channel, got {sums.flatten().tolist()}")
    return (srgb_to_camera / sums).pinverse().to(xyz_to_camera), sums.reciprocal().flatten().to(xyz_to_camera)


def assumed_camera_to_srgb() -> tuple[Tensor, Tensor]:
    """Return the colour matrix and daylight factors of a typical RGB camera, for cameras without a known matrix.

    The results have the form of :func:`camera_to_srgb`.

    Assumes:
        The spectral sensitivities of a Nikon D5100 (measured at NPL). The matrix is fitted by colour-science to the
        training colours of the ACES input transforms in daylight (D65). Colours of other cameras are approximate.

    Source: Darrodi et al., Reference data set for camera spectral sensitivity estimation, JOSA A 2015, for the
        sensitivities; AMPAS P-2013-001 for the fit.
    """
    with _colour_science() as colour:
        fit = colour.matrix_idt(colour.MSDS_CAMERA_SENSITIVITIES[ASSUMED_CAMERA], colour.SDS_ILLUMINANTS["D65"])
        spaces = colour.RGB_COLOURSPACES
        from_aces = colour.matrix_RGB_to_RGB(spaces["ACES2065-1"], spaces["sRGB"], "Bradford")
    matrix, daylight = fit[:2]
    to_srgb = torch.as_tensor(from_aces @ matrix)
    to_srgb = to_srgb / to_srgb.sum(1, keepdim=True)  # colour's white points are rounded: 1e-4
    return to_srgb.float(), torch.as_tensor(daylight).float()


def srgb_from_xyz() -> Tensor:
    """Return the matrix from CIE XYZ to linear sRGB, (3, 3) float64, for the white point D65."""
    return torch.tensor(SRGB_FROM_XYZ, dtype=torch.float64)


@contextmanager
def _colour_science() -> Generator[Any]:
    """Import colour-science with its warnings off and NumPy's print options restored; it takes seconds."""
    with warnings.catch_warnings(), np.printoptions():
        warnings.simplefilter("ignore")
        yield import_installed("colour")
