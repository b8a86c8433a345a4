r"""Operator of the light in the pixels of a sensor from scattered points in the stop of a lens. In C.

.. math:: I_{fdev} = R_{fev} \Big( \sum_k w_k \, |T G_{fdek} T^T|^2 \Big) C_{fev}^T, \qquad
          G_{fdek} = \sum_c u_{ekc} \sum_s a_{fdcs} \, \varphi(y_{fcs}) \, \varphi(x_{fcs})^T

The points s of a patch c of the stop share the wave u of a cell, which differs between exposures e. They lie at (y, x)
on a grid, on which a kernel :math:`\varphi` spreads them. T transforms the grid to samples on the sensor along either
axis, R and C sum samples to pixels. The gradients of waves and weights are also computed in C; gradients of gradients
come from the same in torch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import call, check, differentiable_gradients, operator

SOURCE = KERNELS / "scattered.c"


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
        kernel: its value as a polynomial in :math:`1 - t^2`, with t from -1 to 1 over its width, (n,).
        cosines: real part of T for sums of rows of the grid that lie mirrored about its middle, (L / 2, (M + 1) / 2),
            for samples of the first quarter of a period.
        sines: imaginary part of T for their differences, negative.
    """

    kernel: Tensor
    cosines: Tensor
    sines: Tensor


def scattered_light_by_torch(
    waves: Tensor, weights: Tensor, points: Points, width: int, transform: Transform, rows: Tensor, columns: Tensor
) -> Tensor:
    """Return the same by plain operations, on any device, see :func:`scattered_light`."""
    kernel, cosines, sines = transform
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


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    waves, weights, points, ctx.width, transform, *sums = inputs
    ctx.save_for_backward(waves, weights, *points, *transform, *sums)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
    waves, weights, *given = ctx.saved_tensors
    rest: Any = Points(*given[:4]), ctx.width, Transform(*given[4:7]), *given[7:]
    if not torch.is_grad_enabled():
        found = scattered_light_gradients(waves, weights, *rest, gradient)
    else:  # the gradients are differentiated in turn
        found = differentiable_gradients(
            lambda *own: scattered_light_by_torch(*own, *rest), (waves, weights), gradient, ctx.needs_input_grad[:2]
        )
    return *found, [None] * 4, None, [None] * 3, None, None


@operator(_backward, _keep)
def scattered_light(
    waves: Tensor,
    weights: Tensor,
    points: Sequence[Tensor],
    width: int,
    transform: Sequence[Tensor],
    rows: Tensor,
    columns: Tensor,
) -> Iterator[Tensor]:
    r"""Return the light in the pixels of a sensor: operator ``kornia_tidy::scattered_light``.

    Args:
        waves: u, (E, K, N) complex64 or complex128 on a processor.
        weights: w, (K,), of the waves' real dtype.
        points: a, y and x of :class:`Points`.
        width: of the kernel in samples of the grid.
        transform: kernel and T of :class:`Transform`.
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
    given = waves, weights, points, width, transform, rows, columns
    light, numbers = _new_light(*given)
    yield light
    _fill(light, numbers, given, light=light)


@operator()
def scattered_light_gradients(
    waves: Tensor,
    weights: Tensor,
    points: Sequence[Tensor],
    width: int,
    transform: Sequence[Tensor],
    rows: Tensor,
    columns: Tensor,
    gradient: Tensor,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Return gradients of waves, (E, K, N), and weights, (K,), summed in the same order every time."""
    found = torch.empty_like(waves, memory_format=torch.contiguous_format), torch.empty_like(weights)
    yield found
    given = waves, weights, points, width, transform, rows, columns
    light, numbers = _new_light(*given)
    if gradient.shape != light.shape:
        raise ValueError(f"gradient must have the shape of the light, got {tuple(gradient.shape)}")
    _fill(light, numbers, given, gradient=gradient, of_waves=found[0].zero_(), of_weights=found[1].zero_())


def _new_light(*given: Any) -> tuple[Tensor, tuple[int, ...]]:
    """Check the arguments and return the memory of the result, and the first numbers of the struct in scattered.c."""
    waves, weights, points, width, transform, rows, columns = given
    (cell, values, phase_terms, amplitude_terms), (kernel, cosines, sines) = points, transform
    if waves.dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"waves must be complex64 or complex128, got {waves.dtype}")
    sizes: dict[str, int] = {}
    check(sizes, None, waves=(waves, "E K N"))
    tables = {"cosines": (cosines, "L/2 (M+1)/2"), "sines": (sines, "L/2 (M+1)/2")}
    sums = {"rows": (rows, "F E V P Q"), "columns": (columns, "F E V P Q")}
    check(sizes, waves.dtype.to_real(), weights=(weights, "K"), kernel=(kernel, "n"), **tables, **sums)
    check(sizes, torch.int64, cell=(cell, "C"))
    check(sizes, torch.float64, phase_terms=(phase_terms, "D R"), amplitude_terms=(amplitude_terms, "D A"))
    sizes["2+R+A"] = 2 + sizes["R"] + sizes["A"]
    check(sizes, torch.float64, values=(values, "F 2+R+A C S"))
    if not len(kernel) or width < 1:
        raise ValueError(f"kernel and its width must be at least 1, got {len(kernel)} coefficients and width {width}")
    samples, most = rows.shape[4], 4 * len(cosines)
    if samples % 2 or samples > most:
        raise ValueError(f"rows and columns must have an even number of at most {most} samples, got {samples}")
    extent = 2 * cosines.shape[1] - 1
    numbers = *(sizes[name] for name in "FDEKNCSRA"), width, len(kernel) - 1, extent, len(cosines), samples
    return weights.new_empty([sizes[name] for name in "FDEVPP"]), (*numbers, *rows.shape[2:4])


def _fill(out: Tensor, numbers: tuple[int, ...], given: tuple[Any, ...], **of: Tensor) -> None:
    """Call the function of scattered.c, which fills the light, or reads its gradient and fills those of the rest."""
    waves, weights, points, _, transform, *sums = given
    if not points[1].numel() or not out.numel() or not waves.numel():
        out.zero_()
        return
    first, last = int(points[0].min()), int(points[0].max())
    if first < 0 or last >= waves.shape[2]:
        raise IndexError(f"cell must lie from 0 to {waves.shape[2] - 1}, got {first} to {last}")
    results = (of.get(name) for name in ("gradient", "light", "of_waves", "of_weights"))
    library = load(SOURCE, weights.dtype)
    if call(library.scattered_light, *numbers, waves, weights, *points, *transform, *sums, *results):
        raise ValueError(f"points must lie in the grid of {2 * transform[1].shape[1] - 1} samples")
