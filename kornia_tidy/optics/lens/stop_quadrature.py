"""Quadrature over the open part of the stop, cell by cell of a mask, exact at its edges."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.optics.lens.lens_table import LensSample, degree_of, osa_indices
from kornia_tidy.optics.lens.rays import Array
from kornia_tidy.optics.zernike import zernike_polynomials

_TOUCH = 1e-12  # stop radii
_NEAR = 0.25  # lengths of an interval


@dataclass(frozen=True, eq=False)
class StopQuadrature:
    """Points and weights; those of a patch lie in one cell. C patches, S points in each.

    Args:
        row: of the cell of each patch, (C,).
        column: the same, (C,).
        x: (C, S) in stop radii.
        y: (C, S) in stop radii.
        weight: (C, S) in squared stop radii.
    """

    row: Tensor
    column: Tensor
    x: Tensor
    y: Tensor
    weight: Tensor


def stop_quadrature(
    spans: Array, rule: tuple[Array, Array], discs: Array, shift: tuple[float, float] = (0.0, 0.0)
) -> StopQuadrature:
    """Return the quadrature of cells cut by discs.

    Args:
        spans: begin and end of the cells along either axis, (2, n) in stop radii.
        rule: nodes on [-1, 1] along a side of a patch, and their weights, which sum to two.
        discs: centres x, y and radius of the discs that light must pass, (E, 3) in stop radii.
        shift: y and x by which the cells lie before their spans, in stop radii.

    Example:
        >>> edges = np.linspace(-1.15, 1.15, 24)
        >>> spans, rule = np.stack([edges[:-1], edges[1:]]), np.polynomial.legendre.leggauss(6)
        >>> points = stop_quadrature(spans, rule, np.array([[0.0, 0.0, 1.0]]))
        >>> bool((points.weight.sum() - torch.pi).abs() < 1e-6)
        True
    """
    begin, end = spans
    rows, columns = (part.ravel() for part in np.meshgrid(np.arange(len(begin)), np.arange(len(begin)), indexing="ij"))
    box = np.stack([begin[columns], end[columns], begin[rows], end[rows]])  # x from, x to, y from, y to
    box -= np.repeat(shift[::-1], 2)[:, None]
    keep = (box[1] - box[0] > _TOUCH) & (box[3] - box[2] > _TOUCH)
    whole = keep.copy()
    for x, y, radius in discs:
        ahead = np.maximum(np.abs(box[0] - x), np.abs(box[1] - x)), np.maximum(np.abs(box[2] - y), np.abs(box[3] - y))
        near = np.maximum(0, np.maximum(box[0] - x, x - box[1])), np.maximum(0, np.maximum(box[2] - y, y - box[3]))
        whole &= np.hypot(*ahead) <= radius
        keep &= np.hypot(*near) < radius - _TOUCH
    inner = _patches(box[:, whole], *rule)
    cut = np.flatnonzero(keep & ~whole)
    owner, intervals = _intervals(box[:, cut], discs)
    outer = _cut_patches(box[:, cut][:, owner], intervals, discs, *rule)
    index = np.concatenate([np.flatnonzero(whole), cut[owner]])
    x, y, weight = (torch.from_numpy(np.concatenate(pair)) for pair in zip(inner, outer, strict=True))
    lit = (weight > 0).any(1)
    row, column = torch.from_numpy(rows[index]), torch.from_numpy(columns[index])
    return StopQuadrature(row[lit], column[lit], x[lit], y[lit], weight[lit])


def light_through_stop(sample: LensSample) -> Tensor:
    """Return the area of direction cosines that the open stop fills, (F, D), up to a factor of the lens."""
    found, rule = [], np.polynomial.legendre.leggauss(10)
    for f in range(len(sample.radial)):
        edges = sample.edges[f].numpy()
        discs = np.concatenate([[[0.0, 0.0, 1.0]], np.stack([edges[:, 0], 0 * edges[:, 0], edges[:, 1]], 1)])
        points = stop_quadrature(np.array([[-1.0, -0.5, 0.0, 0.5], [-0.5, 0.0, 0.5, 1.0]]), rule, discs)
        parts = []
        for coefficients in (sample.amplitude[f], sample.illumination[f]):
            count = coefficients.shape[-1]
            degree = degree_of(count)
            basis = zernike_polynomials((degree + 1) * (degree + 2) // 2, points.y, points.x)[osa_indices(count)]
            parts.append(torch.einsum("dj,jcs->dcs", coefficients, basis))
        found.append((parts[0] ** 2 / parts[1] * points.weight).sum((1, 2)))
    return torch.stack(found)


def _patches(box: Array, nodes: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return x, y and weight of the points of whole cells, (C, S) each."""
    size = len(nodes)
    x = (box[0] + box[1])[:, None] / 2 + (box[1] - box[0])[:, None] / 2 * nodes
    y = (box[2] + box[3])[:, None] / 2 + (box[3] - box[2])[:, None] / 2 * nodes
    area = (box[1] - box[0]) * (box[3] - box[2]) / 4
    weight = area[:, None] * np.outer(weights, weights).ravel()
    return np.tile(x, (1, size)), np.repeat(y, size, axis=1), weight


def _intervals(box: Array, discs: Array) -> tuple[np.ndarray, Array]:
    """Return the intervals of x on which a cut cell has one edge below and one above: their cell, and (2, I)."""
    marks = [box[0], box[1]]
    for x, y, radius in discs:
        marks += [np.full_like(box[0], x - radius), np.full_like(box[0], x + radius)]
        for side in box[2:]:
            half = np.sqrt(np.maximum(radius**2 - (side - y) ** 2, 0))
            marks += [x - half, x + half]
    marks += [np.full_like(box[0], at) for pair in combinations(discs, 2) for at in _crossings(*pair)]
    sorted_marks: Array = np.sort(np.clip(np.stack(marks), box[0], box[1]), axis=0)
    begin, end = sorted_marks[:-1], sorted_marks[1:]
    which = np.argwhere((end - begin > _TOUCH).T)  # by cell, then by interval
    return which[:, 0], np.stack([begin[which[:, 1], which[:, 0]], end[which[:, 1], which[:, 0]]])


def _crossings(one: Array, other: Array) -> list[float]:
    """Return x of the points where two circles cross."""
    away = other[:2] - one[:2]
    distance = float(np.hypot(*away))
    if not abs(one[2] - other[2]) < distance < one[2] + other[2]:
        return []
    along = (distance**2 + one[2] ** 2 - other[2] ** 2) / (2 * distance)
    aside = np.sqrt(max(one[2] ** 2 - along**2, 0.0))
    middle = one[0] + along * away[0] / distance
    return [middle - aside * away[1] / distance, middle + aside * away[1] / distance]


def _cut_patches(
    box: Array, intervals: Array, discs: Array, nodes: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Return x, y and weight of the points of cut cells.

    An arc ends in a root at the first and the last x of its disc. Where that is near, a sine smooths it.
    """
    begin, end = intervals
    roots = np.concatenate([discs[:, 0] - discs[:, 2], discs[:, 0] + discs[:, 2]])[:, None]
    near = (np.maximum(begin - roots, roots - end) < _NEAR * (end - begin)).any(0)[:, None]
    begin, end, turn = begin[:, None], end[:, None], np.pi / 2 * nodes
    x = (begin + end) / 2 + (end - begin) / 2 * np.where(near, np.sin(turn), nodes)
    across = (end - begin) / 2 * np.where(near, np.cos(turn) * np.pi / 2, 1.0) * weights
    low, high = np.broadcast_to(box[2][:, None], x.shape), np.broadcast_to(box[3][:, None], x.shape)
    for centre, y, radius in discs:
        arc = np.sqrt(np.maximum(radius**2 - (x - centre) ** 2, 0))
        inside = np.abs(x - centre) <= radius
        low = np.where(inside, np.maximum(low, y - arc), np.inf)
        high = np.where(inside, np.minimum(high, y + arc), -np.inf)
    span = np.maximum(high - low, 0)
    lit = span > 0
    middle = (np.where(lit, low, 0.0) + np.where(lit, high, 0.0)) / 2
    y = middle[..., None] + span[..., None] / 2 * nodes
    weight = (across * span / 2)[..., None] * weights
    size = len(nodes)
    return np.repeat(x, size, axis=1), y.reshape(len(x), -1), weight.reshape(len(x), -1)
