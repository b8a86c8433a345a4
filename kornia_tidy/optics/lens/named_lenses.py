"""Prescriptions of four lenses as published, in millimetres, with the source of each."""

from __future__ import annotations

from typing import Any

_AIR = "air"


def _surfaces(*rows: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Return surfaces from rows (radius, gap, glass behind, clear radius); a row of one number is the stop's gap."""
    found: list[dict[str, Any]] = []
    for row in rows:
        if len(row) == 1:
            found.append({"kind": "stop", "t": row[0]})
        else:
            radius, gap, glass, clear = row
            found.append({"R": radius, "t": gap, "glass": glass, "r": clear})
    return found


def _aspheres(*rows: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Return surfaces from rows (radius, conic constant, gap, glass behind, coefficients of r^3 to r^10)."""
    found: list[dict[str, Any]] = [{"kind": "stop", "t": 0.0}]
    for radius, conic, gap, glass, coefficients in rows:
        powers = dict(enumerate(coefficients, 3))
        found.append({"R": radius, "k": conic, "t": gap, "glass": glass, "poly": powers})
    return found


def _abbe(nd: float, vd: float) -> dict[str, float]:
    return {"nd": nd, "vd": vd}


_DOUBLE_GAUSS = {
    "name": "double-gauss-50mm",
    "unit": "mm",
    "source": (
        "JP 62-87922 A (1987), example 1: 50 mm f/1.8, six elements. Indices by Cauchy's equation through nd and "
        "Abbe's number; clear radii as listed for it at photonstophotos.net"
    ),
    "surfaces": _surfaces(
        (34.30, 4.5, "1", 15.495),
        (247.65, 2.4, _AIR, 15.495),
        (21.51, 4.35, "2", 12.805),
        (40.31, 0.92, _AIR, 12.075),
        (78.44, 1.4, "3", 12.805),
        (15.32, 6.75, _AIR, 9.985),
        (4.95,),
        (-15.83, 1.1, "4", 9.685),
        (135.97, 5.7, "5", 11.88),
        (-21.24, 0.15, _AIR, 11.88),
        (162.15, 3.0, "6", 11.8),
        (-49.97, 0.0, _AIR, 11.8),
    ),
    "index": {
        "1": _abbe(1.6280, 57.0),
        "2": _abbe(1.70154, 41.2),
        "3": _abbe(1.6727, 25.6),
        "4": _abbe(1.6990, 30.1),
        "5": _abbe(1.7995, 42.2),
        "6": _abbe(1.7200, 55.2),
    },
}

_TRIPLET = {
    "name": "triplet-50mm",
    "unit": "mm",
    "source": (
        "J. M. Geary, Introduction to Lens Design (2002): Cooke triplet 50 mm f/5, with N-SK16 in the place of SK16; "
        "indices of Schott's data sheets. The stop 2 mm behind the fourth surface and the clear radii are chosen here"
    ),
    "surfaces": _surfaces(
        (22.01359, 3.25896, "N-SK16", 9.5),
        (-435.76044, 6.00755, _AIR, 9.5),
        (-22.21328, 0.99997, "F2", 5.5),
        (20.29192, 2.0, _AIR, 5.5),
        (2.75041,),
        (79.68360, 2.95208, "N-SK16", 7.5),
        (-18.39533, 0.0, _AIR, 7.5),
    ),
    "index": {
        "N-SK16": {
            "sellmeier": [(1.34317774, 0.00704687339), (0.241144399, 0.0229005), (0.994317969, 92.7508526)],
        },
        "F2": {"sellmeier": [(1.34533359, 0.00997743871), (0.209073176, 0.0470450767), (0.937357162, 111.886764)]},
    },
}

_SINGLE = {
    "name": "single-50mm",
    "unit": "mm",
    "source": (
        "plano-convex, 50 mm at 530 nm, stop at its front: R = f (n - 1), without a publication; index of PMMA: "
        "Sultanova, Kasarova and Nikolov, Acta Physica Polonica A 116, 585 (2009)"
    ),
    "surfaces": _surfaces((0.0,), (24.69099, 3.0, "PMMA", 12.5), (None, 0.0, _AIR, 12.5)),
    "index": {"PMMA": {"sellmeier": [(1.1819, 0.011313)]}},
}

_PHONE = {
    "name": "phone-5.5mm",
    "unit": "mm",
    "source": (
        "US 7,535,658 B2 (2009): four elements f/3.5, half field 32 degrees, aspheres with odd powers; sensor in the "
        "patent's image plane for infinity. Indices by Cauchy's equation through nd and Abbe's number"
    ),
    "image_plane_infinity": 6.61,
    "surfaces": _aspheres(
        (1.962, 1.153, 1.19, "1",
         (-1.895e-2, 2.426e-2, -5.123e-2, 8.371e-4, 7.850e-3, 4.091e-3, -7.732e-3, -4.265e-3)),
        (33.398, 39.18, 0.93, _AIR,
         (-4.966e-3, -1.434e-2, -6.139e-3, -9.284e-5, 6.438e-3, -5.72e-3, -2.385e-2, 1.108e-2)),
        (-2.182, 1.105, 0.75, "2",
         (-4.388e-2, -2.555e-2, 5.16e-2, -4.307e-2, -2.831e-2, 3.162e-2, 4.630e-2, -4.877e-2)),
        (-6.367, 2.382, 0.1, _AIR,
         (-1.131e-1, -7.863e-2, 1.094e-1, 6.228e-3, -2.216e-2, -5.89e-3, 4.123e-3, 1.041e-3)),
        (5.694, -222.1, 0.89, "3",
         (-7.876e-2, 7.02e-2, 1.575e-3, -9.958e-3, -7.322e-3, 6.914e-4, 2.54e-3, -7.65e-4)),
        (9.192, -0.0669, 0.16, _AIR,
         (9.694e-3, -2.516e-3, -3.606e-3, -2.497e-4, -6.84e-4, -1.414e-4, 2.932e-4, -7.284e-5)),
        (1.674, -8.617, 0.85, "3",
         (7.429e-2, -6.933e-2, -5.811e-3, 2.396e-3, 2.100e-3, -3.119e-4, -5.552e-5, 7.969e-6)),
        (1.509, -3.707, 0.70, _AIR,
         (1.767e-3, -4.652e-2, 1.625e-2, -3.522e-3, -7.106e-4, 3.825e-4, 6.271e-5, -2.631e-5)),
        (None, 0.0, 0.40, "4", ()),
        (None, 0.0, 0.0, _AIR, ()),
    ),
    "index": {"1": _abbe(1.471, 76.6), "2": _abbe(1.603, 27.5), "3": _abbe(1.510, 56.2), "4": _abbe(1.516, 64.1)},
}  # fmt: skip

NAMED_LENSES: dict[str, dict[str, Any]] = {
    "double-gauss-50mm": {"prescription": _DOUBLE_GAUSS, "field": 6.784e-3},
    "triplet-50mm": {"prescription": _TRIPLET, "field": 6.784e-3},
    "single-50mm": {"prescription": _SINGLE, "field": 6.784e-3},
    "phone-5.5mm": {"prescription": _PHONE, "field": 3.3e-3},
}
"""Lenses by name: prescription, and largest height on the sensor in metres unless another is asked for."""
