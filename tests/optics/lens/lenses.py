"""Prescriptions that the tests of lenses share, in metres."""

from __future__ import annotations

from typing import Any

INDEX = 1.5


def plano_convex(radius: float = 25e-3, thickness: float = 3e-3, index: float = INDEX) -> dict[str, Any]:
    """A stop in front of a plano-convex element."""
    return {
        "name": "plano-convex",
        "surfaces": [
            {"kind": "stop", "t": 0.0},
            {"R": radius, "t": thickness, "glass": "glass"},
            {"R": None, "t": 0.0},
        ],
        "index": {"glass": index},
    }


def plano_hyperbolic(focal_length: float = 50e-3, index: float = INDEX) -> dict[str, Any]:
    """A plane and a hyperboloid of k = -n^2: light of a star on the axis comes to a perfect focus (Descartes)."""
    return {
        "surfaces": [
            {"kind": "stop", "t": 0.0},
            {"R": None, "t": 5e-3, "glass": "glass"},
            {"R": -focal_length * (index - 1), "k": -(index**2), "t": 0.0},
        ],
        "index": {"glass": index},
    }


def symmetric_pair() -> dict[str, Any]:
    """Two equal plano-convex elements on both sides of the stop: no distortion, coma or lateral colour at unit size."""
    return {
        "surfaces": [
            {"R": 40e-3, "t": 3e-3, "glass": "glass", "r": 6e-3},
            {"R": None, "t": 6e-3},
            {"kind": "stop", "t": 6e-3},
            {"R": None, "t": 3e-3, "glass": "glass"},
            {"R": -40e-3, "t": 0.0, "r": 6e-3},
        ],
        "index": {"glass": {"486.1": 1.522, "587.6": 1.517, "656.3": 1.514}},
    }
