"""A mask to be printed or milled: its surface as a closed body of triangles, STL."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.files import write_bytes
from kornia_tidy.mask_export.slm_frames import checked_heights
from kornia_tidy.masks.base import MASK_SPAN

WALL = 0.01  # pitches that a wall between two pixels leans over: a body, as a printer can make it
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: str | os.PathLike[str], heights: Tensor, pupil_radius: float, base: float = 1e-3) -> None:
    """Write one mask on a plate as binary STL in millimetres, whole or not at all; an existing file is replaced.

    Args:
        path: where to.
        heights: (rows, columns) metres over the plate; below zero they go into it.
        pupil_radius: in metres; 2.3 of it span the mask's shorter side.
        base: thickness of the plate in metres.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if a size is not positive, or a height is not finite or goes through the plate.

    Convention:
        - x to the right, y up, z towards the viewer: the relief seen from above is the mask as the image sees it.
        - The volume is that of the pixels' columns. See :func:`relief`.
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
    """Return a closed body under flat pixels, with walls between them that lean over a hundredth of a pitch.

    Upright walls of four pixels would meet in one edge. Leaning ones make a surface of one height over each place:
    each edge belongs to two triangles. A wall leans as far into one pixel as into the other, and where four pixels meet
    a vertex has their mean, so the volume is that of the columns.

    Args:
        columns: (rows, columns) heights over the bottom.
        pitch: side of a pixel, in the same unit.

    Returns:
        Vertices (V, 3), and for each triangle its vertices (T, 3), counter-clockwise seen from outside.

    Example:
        >>> vertices, triangles = relief(np.ones((1, 1)), 2.0)
        >>> len(vertices), len(triangles)  # a box of which top and sides have two triangles each and the bottom four
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
    meeting[1::2, 1::2] = True  # where four pixels meet: a fan; elsewhere two triangles in one plane
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
    """Turn a body into the bytes of a binary STL file, which has no unit; millimetres are usual.

    Args:
        vertices: (V, 3).
        triangles: (T, 3), counter-clockwise seen from outside.

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
    """Return where pixels begin and end along an axis: half a wall short of their neighbours."""
    begin, end = np.arange(count, dtype=np.float64), np.arange(1, count + 1, dtype=np.float64)
    begin[1:] += WALL / 2
    end[:-1] -= WALL / 2
    return pitch * np.stack([begin, end], 1).ravel()


def _stack(*corners: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([corner.ravel() for corner in corners], 1)
