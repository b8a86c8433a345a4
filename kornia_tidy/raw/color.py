"""Colours of a camera: white balance, and from what its filters pass to linear sRGB."""

from __future__ import annotations

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_choice

# Linear sRGB from CIE XYZ, white (D65) at Y = 1: IEC 61966-2-1's primaries, and the same on the way back.
SRGB_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
ADAPTATIONS = ("Bradford", "CAT02", "CAT16", "Von Kries")
ASSUMED_CAMERA = "Nikon 5100 (NPL)"  # as colour-science names its measured sensitivities


def camera_to_srgb(xyz_to_camera: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return how a camera's balanced colours become linear sRGB, and its white balance for daylight.

    With B the camera's colours of the sRGB primaries, its rows divided by their sums so that sRGB's white gives every
    channel 1, colours are :math:`B^+ c`: the inverse, or for four filters the least squares.

    Args:
        xyz_to_camera: (n, 3) for n = 3 or 4 filters.

    Returns:
        (3, n), whose rows add up to 1, and (n,), the factors that make sRGB's white (D65) equal in all channels.

    Convention:
        LibRaw's and dcraw's: white balance scales the camera's own channels.

    Example:
        >>> matrix, daylight = camera_to_srgb(torch.tensor([[0.9, -0.3, -0.1], [-0.8, 1.6, 0.3], [-0.3, 0.3, 0.8]]))
        >>> matrix.sum(1).round(decimals=4), daylight
        (tensor([1., 1., 1.]), tensor([2.2394, 0.8574, 1.1288]))
    """
    srgb_to_camera = xyz_to_camera.double() @ srgb_from_xyz().inverse()
    sums = srgb_to_camera.sum(1, keepdim=True)
    if not bool((sums > 0).all()):
        raise ValueError(f"xyz_to_camera must see white in every channel, it gives {sums.flatten().tolist()}")
    return (srgb_to_camera / sums).pinverse().to(xyz_to_camera), sums.reciprocal().flatten().to(xyz_to_camera)


def assumed_camera_to_srgb() -> tuple[Tensor, Tensor]:
    """Return what :func:`camera_to_srgb` does, for a camera of which only is known that it has R, G and B filters.

    Assumes:
        The spectral sensitivities of a Nikon D5100 (measured at NPL), and colours like those of the training set of
        the ACES input transforms in daylight (D65), fitted by colour-science. Cameras differ: colours are plausible.

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


def adapted_to_srgb(matrix: Tensor, daylight: Tensor, balance: Tensor, adaptation: str) -> Tensor:
    """Return the matrix (3, n) for colours that were balanced for a light other than daylight.

    White balance alone divides the light out in the camera's channels, which no eye has. Here its factors are taken
    back to those of daylight, colours are converted, and the light's white is then moved to sRGB's in cone responses.

    Args:
        matrix: for daylight, (3, n), and
        daylight: its factors (n,), both as :func:`camera_to_srgb` returns them.
        balance: factors (n,) that the colours were multiplied by; that they make white is taken for true.
        adaptation: a transform of colour-science: ``"Bradford"``, ``"CAT02"``, ``"CAT16"`` or ``"Von Kries"``.

    Raises:
        ValueError: if there is no such transform, or the factors belong to no light.

    Example:
        >>> matrix, daylight = torch.eye(3), torch.ones(3)
        >>> adapted_to_srgb(matrix, daylight, torch.tensor([1.0, 1.0, 1.0]), "Bradford").diagonal().round(decimals=4)
        tensor([1., 1., 1.])
    """
    check_choice("chromatic adaptation", adaptation, ADAPTATIONS)
    from_xyz = srgb_from_xyz()
    undone = matrix.double() * (daylight.double() / balance.double())
    light = from_xyz.inverse() @ undone.sum(1)
    if not bool((light > 0).all()):
        raise ValueError(f"white balance {balance.tolist()} belongs to no light: its XYZ is {light.tolist()}")
    white = from_xyz.inverse().sum(1)
    with _colour_science() as colour:
        moved = colour.adaptation.matrix_chromatic_adaptation_VonKries(
            (light / light[1]).numpy(), white.numpy(), transform=adaptation
        )
    result = from_xyz @ torch.as_tensor(moved) @ from_xyz.inverse() @ undone
    return (result / light[1]).to(matrix)


def srgb_from_xyz() -> Tensor:
    """Return the matrix from CIE XYZ to linear sRGB, (3, 3) float64; both have daylight (D65) for white."""
    return torch.tensor(SRGB_FROM_XYZ, dtype=torch.float64)


@contextmanager
def _colour_science() -> Generator[Any]:
    """Give the module; importing it takes seconds, warns and sets NumPy's print options, and its tables' steps warn."""
    with warnings.catch_warnings(), np.printoptions():
        warnings.simplefilter("ignore")
        import colour  # noqa: PLC0415

        yield colour
