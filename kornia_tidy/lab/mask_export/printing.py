"""STL export: a mask as a closed triangle mesh for 3-D printing or milling."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.files import write_bytes
from kornia_tidy.lab.mask_export.slm_frames import checked_heights
from kornia_tidy.masks.base import MASK_SPAN

WALL = 0.01  # width of the inclined wall between two pixels, in pitches; upright walls would not give a valid body
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: str | os.PathLike[str], heights: Tensor, pupil_radius: float, base: float = 1e-3) -> None:
    """Write one mask on a plate as a binary STL file in millimetres.

    An existing file is replaced, and after an error no partial file remains.

    Args:
        path: file to write.
        heights: (rows, columns) metres above the plate; negative ones are recesses.
        pupil_radius: in metres; the mask's shorter side is 2.3 times as long.
        base: thickness of the plate in metres.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if a size is not positive, or a height is not finite or below the plate's bottom.

    Convention:
        - x points right, y up and z towards the viewer: from above, the relief has the orientation of the image.
        - The volume equals that of the pixels with upright walls. See :func:`relief`.
    """
    check_positive("pupil_radius", pupil_radius, "metres")
    check_positive("base", base, "metres")
    columns = checked_heights(heights[None])[0].numpy() + base
    if columns.min() <= 0:
        raise ValueError(
            f"heights must stay above the bottom of the plate, -{base:g} m, got {columns.min() - base:g} m"
        )
    vertices, triangles = relief(columns, MASK_SPAN * pupil_radius / min(columns.shape))
    write_bytes(path, encode_stl(vertices * 1e3, triangles))


def relief(columns: NDArray[np.float64], pitch: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a closed triangle mesh with flat pixels and slightly inclined walls between them.

    With upright walls, four pixels would share one edge, which is not a valid body. An inclined wall is a hundredth of
    a pitch wide, so the surface has one height at every point and each edge belongs to two triangles. Walls extend
    equally into both pixels, and a vertex where four pixels meet has their mean height, so the volume is that of the
    columns.

    Args:
        columns: (rows, columns) heights above the bottom.
        pitch: side of a pixel, in the same unit.

    Returns:
        Vertices (V, 3), and the three vertex indices of each triangle (T, 3), counter-clockwise from outside.

    Example:
        >>> vertices, triangles = relief(np.ones((1, 1)), 2.0)
        >>> len(vertices), len(triangles)  # a box: two triangles for the top and each side, four for the bottom
        (9, 14)
    """
    rows, cols = columns.shape
    y, x = _corners(rows, pitch), _corners(cols, pitch)
    z = columns.repeat(2, 0).repeat(2, 1)  # each pixel has four corners
    top = np.stack([np.broadcast_to(x, z.shape), np.broadcast_to(y[::-1, None], z.shape), z], -1).reshape(-1, 3)
    means = (columns[1:, 1:] + columns[1:, :-1] + columns[:-1, 1:] + columns[:-1, :-1]) / 4
    seams_x, seams_y = np.meshgrid(pitch * np.arange(1, cols), pitch * np.arange(rows - 1, 0, -1))
    seams = np.stack([seams_x, seams_y, means], -1).reshape(-1, 3)

    index = np.arange(4 * rows * cols).reshape(2 * rows, 2 * cols)
    nw, ne, sw, se = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    meeting = np.zeros(nw.shape, bool)
    meeting[1::2, 1::2] = True  # a fan of four triangles where four pixels meet, elsewhere two triangles in a plane
    plain, centre = ~meeting, len(top) + np.arange(len(seams))
    faces = [_stack(nw[plain], sw[plain], se[plain]), _stack(nw[plain], se[plain], ne[plain])]
    fan = [corner[meeting] for corner in (nw, sw, se, ne)]
    faces += [_stack(a, b, centre) for a, b in zip(fan, fan[1:] + fan[:1], strict=True)]

    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])  # counter-clockwise
    foot = len(top) + len(seams) + np.arange(len(rim))
    after, foot_after = np.roll(rim, -1), np.roll(foot, -1)
    middle = np.full(len(rim), foot[-1] + 1)
    faces += [_stack(rim, foot, foot_after), _stack(rim, foot_after, after), _stack(foot_after, foot, middle)]
    bottom = top[rim] * (1, 1, 0)
    centre_of_bottom = np.array([[cols * pitch / 2, rows * pitch / 2, 0]])
    return np.concatenate([top, seams, bottom, centre_of_bottom]), np.concatenate(faces)


def encode_stl(vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> bytes:
    """Encode a triangle mesh as a binary STL file. The format has no unit; millimetres are usual.

    Args:
        vertices: (V, 3) coordinates.
        triangles: (T, 3) vertex indices, counter-clockwise from outside.

    Returns:
        Bytes of the file.

    Source: 3D Systems, StereoLithography Interface Specification (1989).

    Example:
        >>> len(encode_stl(np.eye(3), np.array([[0, 1, 2]])))
        134
    """
    body: NDArray[Any] = np.zeros(len(triangles), _TRIANGLE)
    body["corners"] = vertices[triangles]
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    body["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    header = b"kornia-tidy phase mask, millimetres".ljust(80)
    return header + np.uint32(len(body)).tobytes() + body.tobytes()


def _corners(count: int, pitch: float) -> NDArray[np.float64]:
    """Return the start and end of each pixel's flat part along an axis, half a wall from its neighbours."""
    begin, end = np.arange(count, dtype=np.float64), np.arange(1, count + 1, dtype=np.float64)
    begin[1:] += WALL / 2
    end[:-1] -= WALL / 2
    return pitch * np.stack([begin, end], 1).ravel()


def _stack(*corners: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([corner.ravel() for corner in corners], 1)
