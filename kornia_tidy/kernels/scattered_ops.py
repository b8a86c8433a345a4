r"""Operator of the light in the pixels of a sensor from scattered points in the stop of a lens. In C.

.. math:: I_{fdev} = R_{fev} \Big( \sum_k w_k \, |T G_{fdek} T^T|^2 \Big) C_{fev}^T, \qquad
          G_{fdek} = \sum_c u_{ekc} \sum_s a_{fdcs} \, \varphi(y_{fcs}) \, \varphi(x_{fcs})^T

The points s of a patch c of the stop share the wave u of a cell, which differs between exposures e. They lie at (y, x)
on a grid, on which a kernel :math:`\varphi` spreads them. T transforms the grid to samples on the sensor along either
axis, R and C sum samples to pixels. The gradients of waves and weights are also computed in C; gradients of gradients
come from the same in torch.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import Parameters, define

SOURCE = KERNELS / "scattered.c"
_NO_MEMORY, _OUTSIDE = 1, 2  # status of the functions


class Points(NamedTuple):
    r"""Points in the stop at F places of the field, in C patches of S points each.

    .. math:: a_d = e^{2 \pi i \sum_r p_{dr} \phi_r} \sum_r q_{dr} A_r

    Args:
        cell: of each patch, whose wave its points share, (C,) int64.
        values: row and column on the grid, R rows of phases :math:`\phi` in turns, and A rows of amplitudes A,
            (F, 2 + R + A, C, S) float64.
        phase_terms: p of each depth, (D, R) float64.
        amplitude_terms: q of each depth, (D, A) float64.
    """

    cell: Tensor
    values: Tensor
    phase_terms: Tensor
    amplitude_terms: Tensor


class Transform(NamedTuple):
    """Kernel that spreads points on a grid, and the transform T of the grid, split by its symmetries.

    Rows of the grid and samples lie evenly about their middles. T is periodic: half a period of 2 L samples away from a
    sample that lies k + 1/2 from the middle is that at k + 1/2 - L.

    Args:
        width: of the kernel in samples of the grid.
        kernel: its value as a polynomial in :math:`1 - t^2`, with t from -1 to 1 over its width, (n,).
        cosines: real part of T for sums of rows of the grid that lie mirrored about its middle, (L / 2, (M + 1) / 2),
            for samples of the first quarter of a period.
        sines: imaginary part of T for their differences, negative.
    """

    width: int
    kernel: Tensor
    cosines: Tensor
    sines: Tensor


def scattered_light(
    waves: Tensor, weights: Tensor, points: Points, transform: Transform, rows: Tensor, columns: Tensor
) -> Tensor:
    r"""Return the light in the pixels of a sensor: operator ``kornia_tidy::scattered_light``.

    Args:
        waves: u, (E, K, N) complex64 or complex128 on a processor.
        weights: w, (K,), of the waves' real dtype.
        points: a, y and x of the points.
        transform: kernel and T.
        rows: R, (F, E, V, P, Q).
        columns: C, (F, E, V, P, Q).

    Returns:
        (F, D, E, V, P, P). It has gradients with respect to waves and weights, which can be differentiated in turn.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit, or points touch samples beyond the grid.
        MemoryError: if memory for the grids is missing.
        NotBuiltError: if the source cannot be compiled.
    """
    return torch.ops.kornia_tidy.scattered_light(waves, weights, *points, *transform, rows, columns)


def scattered_light_by_torch(
    waves: Tensor, weights: Tensor, points: Points, transform: Transform, rows: Tensor, columns: Tensor
) -> Tensor:
    """Return the same by plain operations, on any device, see :func:`scattered_light`."""
    width, kernel, cosines, sines = transform
    extent, found = 2 * cosines.shape[1] - 1, []
    whole = whole_transform(cosines, sines, rows.shape[-1])
    own, phases = waves[..., points.cell], points.phase_terms.shape[1]
    for values, down, right in zip(points.values, rows, columns, strict=True):
        (top, below), (left, beside) = (_spread(place, width, kernel, extent) for place in values[:2])
        lines, across = (torch.arange(part.shape[-1], device=waves.device) for part in (below, beside))
        index = ((top[:, None] + lines)[..., None] * extent + (left[:, None] + across)[:, None]).flatten()
        for p, q in zip(points.phase_terms, points.amplitude_terms, strict=True):
            phase = torch.tensordot(p, values[2 : 2 + phases], 1)
            field = torch.polar(torch.tensordot(q, values[2 + phases :], 1), 2 * torch.pi * (phase - phase.round()))
            parts = (below.mT @ (part.to(kernel.dtype)[..., None] * beside) for part in (field.real, field.imag))
            flat = (own[..., None, None] * torch.complex(*parts)).flatten(2)
            grid = flat.new_zeros(*own.shape[:2], extent**2).index_add(2, index, flat).unflatten(2, (extent, extent))
            sample = whole @ grid @ whole.mT
            light = torch.einsum("k,ekyx->eyx", weights, sample.real.square() + sample.imag.square())
            found.append(down @ light[:, None] @ right.mT)
    shape = len(rows), len(points.phase_terms), *rows.shape[1:4], columns.shape[3]
    return torch.stack(found).view(shape)


def _spread(place: Tensor, width: int, kernel: Tensor, extent: int) -> tuple[Tensor, Tensor]:
    """Return the first sample that each patch touches, (C,), and the weights of its points there, (C, S, T)."""
    start, last = torch.ceil(place.amin(1) - width / 2), torch.floor(place.amax(1) + width / 2)
    if not (float(start.min()) >= 0 and float(last.max()) < extent):
        raise ValueError(f"points must lie in the grid of {extent} samples")
    touched = int((last - start).max()) + 1
    start = start.long().clamp(max=extent - touched)
    away = (start[:, None] + torch.arange(touched, device=place.device))[:, None] - place[..., None]
    inside = 1 - (2 * away / width).square()
    value = torch.zeros_like(inside)
    for coefficient in kernel.flip(0):
        value = value * inside + coefficient
    return start, torch.where(inside > 0, value, 0.0).to(kernel.dtype)


def whole_transform(cosines: Tensor, sines: Tensor, samples: int) -> Tensor:
    """Return T as a complex matrix, (Q, M), see :class:`Transform`.

    Example:
        >>> whole_transform(torch.ones(1, 2), torch.zeros(1, 2), 4).real
        tensor([[-1.,  1., -1.],
                [ 1.,  1.,  1.],
                [ 1.,  1.,  1.],
                [-1.,  1., -1.]])
    """
    signs = 1 - 2 * (torch.arange(cosines.shape[1], device=cosines.device) % 2)
    even, odd = torch.cat([cosines, (signs * cosines).flip(0)]), torch.cat([sines, (-signs * sines).flip(0)])
    upper = torch.cat([torch.complex(even, odd)[:, 1:].flip(1), torch.complex(even, -odd)], 1)[: samples // 2]
    middle = cosines.shape[1] - 1
    upper[:, middle] = upper[:, middle].real + 0j  # its own mirror image: it has no difference
    return torch.cat([upper.flip(0).conj(), upper])


class _Scattered(Parameters):
    """The struct ``scattered`` in scattered.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("places", "depths", "exposures", "states", "cells", "patches", "points")),
        *((name, ctypes.c_int64) for name in ("phases", "amplitudes", "width", "degree", "extent", "quarter")),
        *((name, ctypes.c_int64) for name in ("samples", "shifts", "window", "threads")),
        *((name, ctypes.c_void_p) for name in ("cell", "values", "phase_terms", "amplitude_terms", "kernel", "waves")),
        *((name, ctypes.c_void_p) for name in ("weights", "cosines", "sines", "rows", "columns", "gradient", "light")),
        *((name, ctypes.c_void_p) for name in ("of_waves", "of_weights")),
    )


def _new_light(
    waves: Tensor,
    weights: Tensor,
    cell: Tensor,
    values: Tensor,
    phase_terms: Tensor,
    amplitude_terms: Tensor,
    width: int,
    kernel: Tensor,
    cosines: Tensor,
    sines: Tensor,
    rows: Tensor,
    columns: Tensor,
) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    if waves.dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"waves must be complex64 or complex128, got {waves.dtype}")
    real = waves.dtype.to_real()
    tables = {
        "weights": weights,
        "kernel": kernel,
        "cosines": cosines,
        "sines": sines,
        "rows": rows,
        "columns": columns,
    }
    for name, part in tables.items():
        if part.dtype != real:
            raise TypeError(f"{name} must be of the waves' real dtype {real}, got {part.dtype}")
    terms = {"cell": cell, "values": values, "phase_terms": phase_terms, "amplitude_terms": amplitude_terms}
    for name, part in terms.items():
        if part.dtype != (kind := torch.int64 if part is cell else torch.float64):
            raise TypeError(f"{name} must be {str(kind).removeprefix('torch.')}, got {part.dtype}")
    if waves.ndim != 3 or tuple(weights.shape) != tuple(waves.shape[1:2]):
        shapes = tuple(waves.shape), tuple(weights.shape)
        raise ValueError(f"waves and weights must have shapes (E, K, N) and (K,), got {shapes[0]} and {shapes[1]}")
    depths, phases = phase_terms.shape
    expected = len(rows), 2 + phases + amplitude_terms.shape[1], *cell.shape
    if values.ndim != 4 or tuple(values.shape[:3]) != expected or len(amplitude_terms) != depths:
        raise ValueError(f"values must have shape {(*expected, 'S')} for the terms, got {tuple(values.shape)}")
    if kernel.ndim != 1 or not len(kernel) or width < 1:
        raise ValueError(
            f"kernel must have shape (n,) and a width of at least 1, got {tuple(kernel.shape)} and a width of {width}"
        )
    if cosines.ndim != 2 or cosines.shape != sines.shape:
        raise ValueError(f"cosines and sines must have one shape, got {tuple(cosines.shape)} and {tuple(sines.shape)}")
    most = 4 * len(cosines)
    if rows.ndim != 5 or rows.shape != columns.shape or rows.shape[1] != len(waves):
        raise ValueError(
            f"rows and columns must have shape (F, {len(waves)}, V, P, Q), got {tuple(rows.shape)} and "
            f"{tuple(columns.shape)}"
        )
    if rows.shape[4] % 2 or rows.shape[4] > most:
        raise ValueError(f"rows and columns must have an even number of at most {most} samples, got {rows.shape[4]}")
    return weights.new_empty(len(rows), depths, *rows.shape[1:4], rows.shape[3])


def _light(*given: Any) -> Tensor:
    light = _new_light(*given)
    _call(light, *given)
    return light


def _new_gradients(waves: Tensor, weights: Tensor, *given: Any) -> tuple[Tensor, Tensor]:
    return torch.empty_like(waves, memory_format=torch.contiguous_format), torch.empty_like(weights)


def _gradients(waves: Tensor, weights: Tensor, *given: Any) -> tuple[Tensor, Tensor]:
    """Return (E, K, N) and (K,), summed in the same order every time."""
    *points, gradient = given
    found = _new_gradients(waves, weights)
    if gradient.shape != _new_light(waves, weights, *points).shape:
        raise ValueError(f"gradient must have the shape of the light, got {tuple(gradient.shape)}")
    _call(gradient, waves, weights, *points, of_waves=found[0].zero_(), of_weights=found[1].zero_())
    return found


def _call(light: Tensor, *given: Any, **gradients: Tensor) -> None:
    """Call the function of scattered.c, which fills the light, or reads its gradient and fills those of the rest."""
    waves, weights, cell, values, phase_terms, amplitude_terms, width, kernel, cosines, sines, rows, columns = given
    if not values.numel() or not light.numel() or not waves.numel():
        for out in gradients.values() or (light,):
            out.zero_()
        return
    if int(cell.min()) < 0 or int(cell.max()) >= waves.shape[2]:
        raise IndexError(f"cell must lie from 0 to {waves.shape[2] - 1}, got {int(cell.min())} to {int(cell.max())}")
    scattered = _Scattered(
        places=len(rows),
        depths=len(phase_terms),
        exposures=len(waves),
        states=waves.shape[1],
        cells=waves.shape[2],
        patches=len(cell),
        points=values.shape[3],
        phases=phase_terms.shape[1],
        amplitudes=amplitude_terms.shape[1],
        width=width,
        degree=len(kernel) - 1,
        extent=2 * cosines.shape[1] - 1,
        quarter=len(cosines),
        samples=rows.shape[4],
        shifts=rows.shape[2],
        window=rows.shape[3],
    )
    scattered.point_to(
        cell=cell,
        values=values,
        phase_terms=phase_terms,
        amplitude_terms=amplitude_terms,
        kernel=kernel,
        waves=waves.resolve_conj(),
        weights=weights.resolve_neg(),
        cosines=cosines,
        sines=sines,
        rows=rows,
        columns=columns,
        **({"gradient": light.resolve_neg()} if gradients else {"light": light}),
        **gradients,
    )
    status = load(SOURCE, weights.dtype).scattered_light(ctypes.byref(scattered))
    if status == _OUTSIDE:
        raise ValueError(f"points must lie in the grid of {2 * cosines.shape[1] - 1} samples")
    if status == _NO_MEMORY:
        raise MemoryError(f"no memory for PSFs of {rows.shape[2]}x{rows.shape[2]} pixels")


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))
    ctx.width = inputs[6]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    waves, weights, *given = ctx.saved_tensors
    given.insert(4, ctx.width)
    rest = (None,) * len(given)
    if not torch.is_grad_enabled():
        return *torch.ops.kornia_tidy.scattered_light_gradients(waves, weights, *given, gradient), *rest
    own = waves.view_as(waves), weights.view_as(weights)  # the gradients are differentiated in turn
    light = scattered_light_by_torch(*own, Points(*given[:4]), Transform(*given[4:8]), *given[8:])
    found = iter(torch.autograd.grad(light, [x for x in own if x.requires_grad], gradient, create_graph=True))
    return *(next(found) if x.requires_grad else None for x in own), *rest


_GIVEN = (
    "Tensor waves, Tensor weights, Tensor cell, Tensor values, Tensor phase_terms, Tensor amplitude_terms, int width, "
    "Tensor kernel, Tensor cosines, Tensor sines, Tensor rows, Tensor columns"
)
define("scattered_light", f"({_GIVEN}) -> Tensor", _light, _new_light, _backward, _keep)
define("scattered_light_gradients", f"({_GIVEN}, Tensor gradient) -> (Tensor, Tensor)", _gradients, _new_gradients)
