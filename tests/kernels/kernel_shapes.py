"""Random calls of the C sources, each with what it should return and the round-off that this may be off by.

Planes are as small as a kernel takes, or have odd sizes, overlap their neighbours in memory, and have PSFs larger than
a block; layers lie in every way in which they are found (one, noise, stripes, squares), nearest and linear.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from scipy import stats
from torch import Tensor
from torch.nn.functional import conv2d, one_hot, pad

from kornia_tidy.kernels import gather_ops, occlusion_ops
from kornia_tidy.kernels.places import Places
from kornia_tidy.kernels.window_sides import is_window_size, size_step
from kornia_tidy.psf.energies import LARGEST_WINDOW
from kornia_tidy.psf.field import Field
from kornia_tidy.render.backends.dense import DenseBackend
from kornia_tidy.render.backends.dense_occlusion import (
    EPSILON,
    OcclusionPlanes,
    cumulative_weight,
    occlude_dense,
    occlusion_planes,
)
from kornia_tidy.render.borders import BORDERS, pad_border
from kornia_tidy.render.layers import weight_of_layer
from kornia_tidy.render.scene import LayeredScene, layered_scene
from kornia_tidy.render.stray_light import normalised_share
from tests.psf.energies_tester import gradient_round_off, round_off, written_out
from tests.rounding import gamma, magnitude

DTYPES = (torch.float32, torch.float64)


LARGEST = 3 * 10**6  # products, of calls
CHEAP = 3 * 10**5  # products, of calls whose values are checked too, which takes longer than the calls


@dataclass(frozen=True)
class Call:
    """An operator's arguments, and what it should return.

    Args:
        about: the shapes, in words.
        name: of the operator.
        arguments: of the operator.
        products: number of products.
        truth: returns the result in float64, and how far apart they may be.
    """

    about: str
    name: str
    arguments: tuple[Any, ...]
    products: int
    truth: Callable[[], tuple[Tensor, Tensor | float]]

    @property
    def operator(self) -> torch._ops.OpOverload:
        """The operator."""
        return getattr(torch.ops.kornia_tidy, self.name).default

    @cached_property
    def got(self) -> Tensor:
        """What the operator returns, of gradients the first one, complex ones as real numbers."""
        made = self.operator(*self.arguments)
        first = made[0] if isinstance(made, (list, tuple)) else made
        return torch.view_as_real(first) if first.is_complex() else first

    def error(self) -> float:
        """Return the largest difference as a multiple of the allowed one."""
        expected, allowed = self.truth()
        off = (self.got.double() - expected).abs()
        return float(torch.where(off > 0, off / allowed, 0).max())


@dataclass(frozen=True)
class _Scene:
    light: Tensor
    psfs: Tensor
    lower: Tensor
    fraction: Tensor | None
    about: str
    products: int
    places: Places | None = None


def gather(draw: random.Random) -> Call:
    """``mix`` of direct.c, through any PSFs and through discs, which take sums of the light down its columns."""
    scene, discs = _gathered(draw), draw.random() < 0.4
    if discs:
        squared = torch.arange(scene.psfs.shape[-1]).sub(scene.psfs.shape[-1] // 2).square()
        area = (draw.random() * scene.psfs.shape[-1] / 1.8) ** 2
        one = torch.randn_like(scene.psfs[:, :, :1, :1])
        scene = replace(scene, psfs=one * (squared + squared[:, None] <= area), about=f"discs {scene.about}")
    weight_gradient = scene.fraction is not None and draw.random() < 0.5

    def truth() -> tuple[Tensor, Tensor]:
        weights = _weights(scene, gradient=weight_gradient)
        expected, total = (_mixed(x(scene.light), x(scene.psfs), x(weights)) for x in (Tensor.double, _magnitudes))
        side = scene.psfs.shape[-1]
        allowed = 2 * gamma(side**2 + 4, scene.light.dtype) * total
        if discs:  # each end of a run takes at most the light of a whole column
            ends = pad(_magnitudes(scene.psfs), (0, 0, 1, 1)).diff(dim=-2).abs()
            terms = int(ends.count_nonzero((-2, -1)).max()) + side + 16
            reach = float(ends.sum((-2, -1)).max() * _magnitudes(scene.light).sum(-2).max())
            allowed = allowed + gamma(terms, scene.light.dtype) * reach
        return expected, allowed

    arguments = scene.light, scene.psfs, scene.lower, scene.fraction, False, weight_gradient
    about = f"{scene.about} weight_gradient {weight_gradient}"
    return Call(about, "gather_direct", arguments, scene.products, truth)


def overlap_gather(draw: random.Random) -> Call:
    """``gather`` of overlap.c."""
    return _overlap_gather(draw, _overlapping(draw))


def field_gather(draw: random.Random) -> Call:
    """``gather`` of overlap.c with PSFs that vary over the field."""
    return _overlap_gather(draw, _over_field(draw))


def _overlap_gather(draw: random.Random, drawn: tuple[_Scene, int, bool]) -> Call:
    scene, size, correlate = drawn
    weight_gradient = scene.fraction is not None and draw.random() < 0.3

    def truth() -> tuple[Tensor, float]:
        psfs, weights = scene.psfs.double(), _weights(scene, gradient=weight_gradient)
        expected = _placed(scene, scene.light.double(), psfs.flip((-2, -1)) if correlate else psfs, weights)
        return expected, 2 * _overlap_error(scene, scene.light, size)

    arguments = scene.light, scene.psfs, scene.lower, scene.fraction, size, correlate, weight_gradient
    about = f"{scene.about} size {size} correlate {correlate} weight_gradient {weight_gradient}"
    return Call(about, "gather_overlap", (*arguments, _listed(scene)), scene.products, truth)


def overlap_scatter(draw: random.Random) -> Call:
    """``scatter`` of overlap.c: the transpose of ``gather``."""
    return _overlap_scatter(draw, _overlapping(draw))


def field_scatter(draw: random.Random) -> Call:
    """``scatter`` of overlap.c with PSFs that vary over the field."""
    return _overlap_scatter(draw, _over_field(draw))


def _overlap_scatter(draw: random.Random, drawn: tuple[_Scene, int, bool]) -> Call:
    scene, size, correlate = drawn
    pixels = _pixels(draw, scene)

    def truth() -> tuple[Tensor, float]:
        light, psfs = scene.light.double().requires_grad_(), scene.psfs.double()
        coded = _placed(scene, light, psfs if correlate else psfs.flip((-2, -1)), _weights(scene))
        expected = torch.autograd.grad((coded * pixels.double()).sum(), light)[0]
        layers, side = scene.psfs.shape[-4], scene.psfs.shape[-1]
        # Windows of four tiles overlap, and of more where tiles over the field are narrow.
        together = (
            4
            if scene.places is None
            else math.prod(
                max(2, int(((x[None] < x[:-1, None] + side - 1) & (x[None] >= x[:-1, None])).sum(1).max()) + 1)
                for x in (scene.places.row_edges, scene.places.column_edges)
            )
        )
        return expected, together * layers * _overlap_error(scene, pixels, size)

    arguments = pixels, scene.psfs, scene.lower, scene.fraction, size, correlate
    about = f"{scene.about} size {size} correlate {correlate}"
    return Call(about, "scatter_overlap", (*arguments, _listed(scene)), scene.products, truth)


def overlap_correlate(draw: random.Random) -> Call:
    """``correlate`` of overlap.c: the gradient of a sum over pixels to the PSFs."""
    return _overlap_correlate(draw, _overlapping(draw))


def field_correlate(draw: random.Random) -> Call:
    """``correlate`` of overlap.c: the gradient of the PSFs at the nodes of a field."""
    return _overlap_correlate(draw, _over_field(draw))


def _overlap_correlate(draw: random.Random, drawn: tuple[_Scene, int, bool]) -> Call:
    scene, size, correlate = drawn
    pixels = _pixels(draw, scene)

    def truth() -> tuple[Tensor, Tensor | float]:
        psfs = scene.psfs.double().requires_grad_()
        turned = psfs.flip((-2, -1)) if correlate else psfs
        coded = _placed(scene, scene.light.double(), turned, _weights(scene))
        expected = torch.autograd.grad((coded * pixels.double()).sum(), psfs)[0]
        allowed: Tensor | float = 2 * _transform_error(scene.light, pixels, size)
        if (places := scene.places) is not None:
            rows, columns = (
                x.abs().amax(0)[0] + 2 * size * x.abs().amax(0)[1] for x in (places.row_weights, places.column_weights)
            )
            allowed = allowed * (rows[:, None] * columns)[..., None, None, None, None]
        return expected, allowed

    arguments = scene.light, pixels, scene.lower, scene.fraction, scene.psfs.shape[-4], size, correlate
    about = f"{scene.about} size {size} correlate {correlate}"
    return Call(about, "overlap_psf_gradient", (*arguments, _listed(scene)), scene.products, truth)


def occlude(draw: random.Random) -> Call:
    """``occlude`` and ``count`` of occlusion.c.

    Light, layers and what is behind them are sums of positive numbers, each off by gamma of itself; a share that is let
    through is a difference and keeps its absolute error, which grows with each layer, and so does the sum of layers. In
    float64 whole weights come from differences of sums up to 1, which a layer seen by a single pixel is divided by.
    """
    return _occlude(_occluding(draw))


def field_occlude(draw: random.Random) -> Call:
    """``occlude`` of occlusion.c with PSFs that vary over the field: up to three planes for each."""
    return _occlude(_occluding_over_field(draw))


def _occlude(drawn: tuple[tuple[Any, ...], LayeredScene, str, int]) -> Call:
    arguments, scene, about, products = drawn
    psfs = arguments[1] if scene.field is None else arguments[1][0, 0]
    assert occlusion_ops.count_operations(*arguments[2:4], psfs, len(arguments[0])) >= 0, about

    def truth() -> tuple[Tensor, float]:
        return DenseBackend().render(scene), 6 * _terms(scene) * _occlusion_error(psfs, psfs.shape[-1] ** 2 + 16)

    return Call(about, "occlusion_direct", arguments, products, truth)


def _terms(scene: LayeredScene) -> int:
    """Sums and their magnitude for each sum of one PSF: nodes are blended, and slopes weighted and added."""
    return 1 if scene.field is None else 3 * sum(scene.field.nodes)


def occlude_gradient(draw: random.Random) -> Call:
    """``occlusion_gradients`` of occlusion.c, that of the PSFs.

    What the blurred planes pass on is as exact as the light, to a share of its bound. With light up to 1 and a gradient
    g that is g T / E for light, twice as much for alpha, and as much times alpha / E for E. Products of these with
    light and weights are summed in the light's type along a band of blocks.
    """
    return _occlude_gradient(_occluding(draw))


def field_occlude_gradient(draw: random.Random) -> Call:
    """``occlusion_gradients`` of occlusion.c for the PSFs at the nodes of a field."""
    return _occlude_gradient(_occluding_over_field(draw))


def _occlude_gradient(drawn: tuple[tuple[Any, ...], LayeredScene, str, int]) -> Call:
    arguments, scene, about, products = drawn
    psfs = arguments[1]
    gradient = torch.randn(*scene.image.shape[:2], *scene.output_size, dtype=psfs.dtype)

    def over_field() -> tuple[Tensor, Tensor]:
        exact, shares = scene.psfs.detach().double().clone().requires_grad_(), scene.places.of_pixels()
        planes = occlusion_planes(scene)._replace(psfs=exact)
        (expected,) = torch.autograd.grad((occlude_dense(*planes, shares) * gradient).sum(), exact)
        one, roundings = psfs[0, 0], psfs.shape[-1] ** 2 + 16 + 8 * gradient.shape[-1] + gradient.shape[-2]
        # The nodes' magnitudes are the largest; a PSF's light adds as much as light itself, to all samples.
        axis = planes._replace(psfs=torch.stack(list(scene.psfs)).amax(0).double().requires_grad_())
        magnitude = _occlusion_magnitude(axis, gradient.abs())
        magnitude = 2 * (magnitude + magnitude.amax((-2, -1), keepdim=True))
        bound = 12 * _terms(scene) * _occlusion_error(one, roundings) * magnitude
        nodes = expected.unflatten(0, psfs.shape[:2])
        return nodes, bound.expand_as(nodes)

    def truth() -> tuple[Tensor, Tensor]:
        if scene.field is not None:
            return over_field()
        exact = psfs.detach().double().clone().requires_grad_()
        planes = occlusion_planes(scene)._replace(psfs=exact)
        (expected,) = torch.autograd.grad((occlude_dense(*planes) * gradient).sum(), exact)
        roundings = psfs.shape[-1] ** 2 + 16 + 8 * gradient.shape[-1]
        return expected, 12 * _occlusion_error(psfs, roundings) * _occlusion_magnitude(planes, gradient.abs())

    given = *arguments, gradient, [False, True, False, False]
    return Call(about, "occlusion_direct_gradients", given, 3 * products, truth)


def occlude_light_gradient(draw: random.Random) -> Call:
    """``occlusion_gradients`` of occlusion.c, that of the light: products of PSFs, weights and what blocks pass on."""
    return _occlude_light_gradient(_occluding(draw))


def field_occlude_light_gradient(draw: random.Random) -> Call:
    """The same with PSFs that vary over the field."""
    return _occlude_light_gradient(_occluding_over_field(draw))


def _occlude_light_gradient(drawn: tuple[tuple[Any, ...], LayeredScene, str, int]) -> Call:
    arguments, scene, about, products = drawn
    gradient = torch.randn(*scene.image.shape[:2], *scene.output_size, dtype=arguments[1].dtype)

    def truth() -> tuple[Tensor, Tensor]:
        planes, shares = occlusion_planes(scene), None if scene.field is None else scene.places.of_pixels()
        planes = planes._replace(light=planes.light.double().clone().requires_grad_(), psfs=planes.psfs.double())
        (expected,) = torch.autograd.grad((occlude_dense(*planes, shares) * gradient).sum(), planes.light)
        axis = planes.psfs if shares is None else 2 * planes.psfs.amax(0)
        magnitude = _occlusion_magnitude(planes._replace(psfs=axis), gradient.abs(), planes.light)
        error = _occlusion_error(axis.to(gradient), axis.shape[-1] ** 2 + 16)
        of_truth = 1e-15 * expected.abs().max()  # by transforms, whose round-off is that of the largest numbers
        return expected, 12 * _terms(scene) * error * magnitude + of_truth

    given = *arguments, gradient, [True, False, False, False]
    return Call(about, "occlusion_direct_gradients", given, 3 * products, truth)


def _occlusion_error(psfs: Tensor, roundings: int) -> float:
    layers, apart = len(psfs), 1 if psfs.dtype == torch.float32 else 1 + 3 * psfs.shape[-1] ** 2
    return layers * (layers + 1) * apart * gamma(roundings, psfs.dtype)


def _occlusion_magnitude(planes: OcclusionPlanes, gradient: Tensor, of: Tensor | None = None) -> Tensor:
    """Sums of the magnitudes of all terms of a gradient: of the PSFs, or of another one of the planes."""
    light, psfs, weight, _, _, index, inside = planes
    weight, lit = None if weight is None else weight.double(), 1 if inside is None else inside[:, None]

    def blur(plane: Tensor, psf: Tensor) -> Tensor:
        plane = (plane * lit).double().expand(-1, len(psf), -1, -1)
        return conv2d(plane, psf.flip((-2, -1))[:, None], groups=len(psf))

    total, passed = torch.zeros(()), torch.ones(())
    for layer in reversed(range(len(psfs))):
        weights = (weight_of_layer(index, weight, layer), cumulative_weight(index, weight, layer))
        own, cumulative = (x[:, None].double() for x in weights)
        alpha, seen = blur(own, psfs[layer]), blur(cumulative, psfs[layer])
        divisor = seen.detach() + EPSILON
        share = alpha.detach() / divisor
        terms = blur(own * light, psfs[layer]) + 2 * alpha + 2 * share * seen
        total, passed = total + (gradient * passed / divisor * terms).sum(), passed * (1 - share)
    return torch.autograd.grad(total, psfs if of is None else of)[0]


def _occluding(draw: random.Random) -> tuple[tuple[Any, ...], LayeredScene, str, int]:
    """Arguments of ``occlusion_direct`` and the scene they are of, the shapes in words, and the number of products."""
    dtype, border = draw.choice(DTYPES), draw.choice(BORDERS)
    products = LARGEST + 1
    while products > LARGEST:
        side, layers, channels = draw.choice((1, 3, 5, 7, 9, 15, 17, 31)), draw.randint(1, 6), draw.choice((1, 3))
        smallest, edge = (8, 128 // dtype.itemsize), side - 1 if border == "valid" else 0
        height, width = (_size(draw, max(n, side // 2 + 1), 60) + edge for n in smallest)
        images, maps = draw.choice(((1, 1), (2, 1), (2, 2)))
        products = images * channels * layers * height * width * side**2
    psfs = torch.rand(layers, channels, side, side, dtype=dtype) + 0.5
    psfs /= psfs.sum((-2, -1), keepdim=True)
    image = torch.rand(images, channels, height, width, dtype=dtype)
    lower, fraction = _layers(draw, (maps, height, width), layers, dtype)
    veil = torch.rand(layers, channels, dtype=dtype) if draw.random() < 0.5 else None
    about = f"{dtype} {border} {tuple(image.shape)} maps {maps} psfs {tuple(psfs.shape)} shared {fraction is not None}"

    radius = side // 2
    plane = pad_border(image, radius, border)
    below = pad_border(lower[:, None].to(dtype), radius, border)[:, 0]
    share = None if fraction is None else pad_border(fraction[:, None], radius, border)[:, 0]
    inside = pad_border(torch.ones(1, 1, height, width, dtype=dtype), radius, border)[0] if border == "zero" else None
    mean = None if veil is None else image.mean((-2, -1))
    seen = None if veil is None else normalised_share(veil, psfs, image.shape[-2:], border)
    at, mode = lower[:, None].double(), "nearest"
    if fraction is not None:
        at, mode = at + fraction[:, None], "linear"
    nodes = torch.arange(layers, dtype=torch.float64)
    scene = layered_scene(image, at, nodes, psfs, veil, "occlusion", mode, border)
    return (plane, psfs, below, share, mean, seen, inside, []), scene, about, products


def _occluding_over_field(draw: random.Random) -> tuple[tuple[Any, ...], LayeredScene, str, int]:
    """As above with PSFs at nodes over the field, tiles of any sizes, and no stray light."""
    drawn = _occluding(draw)
    while drawn[1].stray_light is not None or drawn[3] > LARGEST / 9:
        drawn = _occluding(draw)
    arguments, scene, about, products = drawn
    nodes, parts = (draw.randint(1, 3), draw.randint(1, 3)), []
    for pixels, most, many in zip(scene.output_size, occlusion_ops.TILE, nodes, strict=True):
        edges = [0]
        while edges[-1] < pixels:
            edges.append(min(pixels, edges[-1] + draw.choice((most, most, draw.randint(1, most)))))
        middles = torch.tensor(edges[1:], dtype=torch.float64) - 8 * torch.rand(len(edges) - 1, dtype=torch.float64)
        weights = torch.rand(len(edges) - 1, 2, many, dtype=torch.float64) + 0.5
        weights[:, 1] = (weights[:, 1] - 1) * draw.choice((0, 0.01, 0.01))  # PSFs stay above zero
        weights[:, 0] /= weights[:, 0].sum(-1, keepdim=True)
        parts += [torch.tensor(edges), middles, weights]
    psfs = arguments[1] * (0.75 + 0.5 * torch.rand(*nodes, *arguments[1].shape, dtype=arguments[1].dtype))
    scene = replace(scene, psfs=psfs.flatten(0, 1), field=Field(scene.output_size, nodes))
    vars(scene)["places"] = Places(*parts)  # in place of tiles of one size
    about = f"{about} nodes {nodes} tiles {len(parts[1])}x{len(parts[4])}"
    return (arguments[0], psfs, *arguments[2:7], parts), scene, about, math.prod(nodes) * products


def energies(draw: random.Random) -> Call:
    """``mutual_energies`` of mutual_intensity.c."""
    case, about, products = _partially_coherent(draw)

    def truth() -> tuple[Tensor, Tensor]:
        return written_out(*_in_double(case)), 2 * round_off(*case)

    return Call(about, "mutual_intensity_energies", case, products, truth)


def field_gradient(draw: random.Random) -> Call:
    """``mutual_field_gradient`` of mutual_intensity.c."""
    case, about, products = _partially_coherent(draw)
    light = torch.randn(len(case[2]), *(case[2].shape[1],) * 2, dtype=case[1].dtype)

    def truth() -> tuple[Tensor, Tensor]:
        exact = _in_double(case)
        exact[0].requires_grad_()
        (expected,) = torch.autograd.grad((written_out(*exact) * light.double()).sum(), exact[0])
        allowed = gradient_round_off(tuple(x.detach() for x in exact), light.double(), light.dtype)[0]
        return torch.view_as_real(expected), 2 * allowed[..., None]

    return Call(about, "mutual_field_gradient", (*case, light), 2 * products, truth)


def scattered(draw: random.Random) -> Call:
    """``scattered_light`` of scattered.c: the light."""
    case, about, products = _scattered(draw)
    return Call(about, "scattered_light", scattered_arguments(case), products, lambda: scattered_written_out(*case))


def scattered_arguments(case: tuple[Any, ...]) -> tuple[Any, ...]:
    """The operator's arguments from those of ``scattered_written_out``."""
    return *case[:2], list(case[2:6]), case[6], list(case[7:10]), *case[10:]


def scattered_gradient(draw: random.Random) -> Call:
    """The same for a gradient of the light: that of the waves."""
    case, about, products = _scattered(draw)
    light = torch.randn(len(case[3]), len(case[4]), *(case[10].shape[n] for n in (1, 2, 3, 3)), dtype=case[1].dtype)

    def truth() -> tuple[Tensor, Tensor]:
        exact = [case[0].to(torch.complex128, copy=True).requires_grad_(), case[1].double()]
        value, _ = scattered_written_out(*exact, *case[2:])
        (expected,) = torch.autograd.grad((value * light.double()).sum(), exact[0])
        large = magnitude(case[0]).to(torch.complex128).requires_grad_()
        _, allowed = scattered_written_out(large, case[1].double(), *case[2:])
        (bound,) = torch.autograd.grad((allowed * light.double().abs()).sum(), large)
        return torch.view_as_real(expected), 2 * bound.real[..., None]

    return Call(about, "scattered_light_gradients", (*scattered_arguments(case), light), 2 * products, truth)


def scattered_written_out(
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
) -> tuple[Tensor, Tensor]:
    """The light by complex matrices in float64, and the round-off that it may be off by.

    That is the same sum of moduli, times the roundings of each product. The kernel's argument is rounded too, which its
    coefficients times their powers bound, and so is the phase, by less than six roundings of a radian.
    """
    dtype, phases = weights.dtype if kernel.dtype == torch.float64 else kernel.dtype, phase_terms.shape[1]
    extent, patches, points = 2 * cosines.shape[1] - 1, *values.shape[2:]
    powers = torch.arange(len(kernel), dtype=torch.float64)
    lines = torch.arange(extent, dtype=torch.float64)
    whole = torch.zeros(rows.shape[-1], extent, dtype=torch.complex128)
    for n in range(len(whole)):  # samples and rows lie about their middles
        k, side = (n - len(whole) // 2, 1) if n >= len(whole) // 2 else (len(whole) // 2 - 1 - n, -1)
        far = k >= len(cosines)
        for m in range(extent):
            i = abs(m - extent // 2)
            at = (2 * len(cosines) - 1 - k if far else k), i
            sign = (-1) ** i if far else 1
            turn = side * ((m > extent // 2) - (m < extent // 2)) * (-sign if far else 1)
            whole[n, m] = sign * cosines[at].double() - 1j * turn * sines[at].double()
    large = whole.real.abs() + whole.imag.abs()
    found, allowed = [], []
    roundings = points * patches + 2 * extent + 2 * len(weights) + len(whole) + 8 * len(kernel) + 64
    for place, down, right in zip(values, rows.double(), columns.double(), strict=True):
        inside = 1 - (2 * (lines - place[:2, ..., None]) / width).square()  # (2, C, S, M)
        spread = torch.where(inside > 0, (inside[..., None] ** powers * kernel.double()).sum(-1), 0.0)
        broad = torch.where(inside > -1e-3, ((1 + 4 * width * powers) * kernel.double().abs()).sum(), 0.0)
        for p, q in zip(phase_terms, amplitude_terms, strict=True):
            size = torch.tensordot(q, place[2 + phases :], 1)
            field = (
                torch.polar(torch.ones_like(size), 2 * torch.pi * torch.tensordot(p, place[2 : 2 + phases], 1)) * size
            )
            moduli = torch.tensordot(q.abs(), place[2 + phases :].abs(), 1)
            own = waves[..., cell].to(torch.complex128)
            grid = torch.einsum("ekc,cs,csm,csn->ekmn", own, field, spread[0].to(own), spread[1].to(own))
            light = torch.einsum("k,ekyx->eyx", weights.double(), (whole @ grid @ whole.mT).abs().square())
            most = torch.einsum("ekc,cs,csm,csn->ekmn", own.real.abs() + own.imag.abs(), moduli, *broad)
            bound = torch.einsum("k,ekyx->eyx", weights.double(), (large @ most @ large.mT).square())
            found.append(down @ light[:, None] @ right.mT)
            allowed.append(gamma(roundings, dtype) * (down.abs() @ bound[:, None] @ right.mT.abs()))
    shape = len(rows), len(phase_terms), *rows.shape[1:4], rows.shape[3]
    return torch.stack(found).view(shape), torch.stack(allowed).view(shape)


def srgb(draw: random.Random) -> Call:
    """``decode`` and ``encode`` of pixels.c: to 2e-7 in float32, and to 16 roundings of the value."""
    image, encode, about = _colours(draw)

    def truth() -> tuple[Tensor, Tensor]:
        expected = srgb_by_definition(image.double(), encode)
        least = 2e-7 if image.dtype == torch.float32 else gamma(16, image.dtype)
        return expected, (gamma(16, image.dtype) * expected.abs()).clamp(min=least)

    return Call(about, "srgb", (image, encode), image.numel(), truth)


def srgb_gradient(draw: random.Random) -> Call:
    """``decode`` and ``encode`` of pixels.c with a gradient: to 16 roundings of it."""
    image, encode, about = _colours(draw)
    gradient = torch.randn_like(image)

    def truth() -> tuple[Tensor, Tensor]:
        exact = image.detach().double().requires_grad_()
        (expected,) = torch.autograd.grad(srgb_by_definition(exact, encode), exact, gradient.double())
        return expected, gamma(16, image.dtype) * expected.abs() + torch.finfo(image.dtype).tiny

    return Call(about, "srgb", (image, encode, gradient), image.numel(), truth)


def srgb_by_definition(image: Tensor, encode: bool) -> Tensor:
    """The formulas of IEC 61966-2-1."""
    if encode:
        return torch.where(image > 0.0031308, 1.055 * image.clamp(min=0.003) ** (1 / 2.4) - 0.055, 12.92 * image)
    return torch.where(image > 0.04045, ((image.clamp(min=0.04) + 0.055) / 1.055) ** 2.4, image / 12.92)


def _colours(draw: random.Random) -> tuple[Tensor, bool, str]:
    """An image in any order of memory, mostly of [0, 1], whether it is to be encoded, and all this in words."""
    image, about = _light(draw)
    encode = draw.random() < 0.5
    return image, encode, f"{about} encode {encode}"


def _light(draw: random.Random) -> tuple[Tensor, str]:
    """An image in any order of memory, mostly of [0, 1], and what it is in words."""
    dtype = draw.choice(DTYPES)
    shape = *(draw.randint(2, 9) for _ in range(draw.randint(0, 2))), draw.choice((1, 2, 15, 16, 17, 40, 999))
    image = 2 * torch.rand(shape, dtype=dtype) ** 3 * draw.choice((1, 1, 1, 40)) - draw.choice((0, 0.1))
    memory = draw.choice(("dense", "turned", "cut out", "shared"))
    if memory == "turned":
        image = image.T.contiguous().T if image.ndim == 2 else image.movedim(0, -1).contiguous().movedim(-1, 0)
    elif memory == "cut out":
        image = pad(image, (1, 2))[..., 1:-2]
    elif memory == "shared":
        image = image[..., :1].expand(shape)
    return image, f"{dtype} {shape} {memory}"


@dataclass(frozen=True)
class _Recorded:
    """What a sensor makes of light.

    Args:
        values: recorded, in float64.
        off: how far round-off may move them; infinity where it may change a count of electrons.
        slope: derivative to the light.
        torn: where round-off may change the derivative: beside a step of the converter, and where values are clipped.
    """

    values: Tensor
    off: Tensor
    slope: Tensor
    torn: Tensor


def sensor(draw: random.Random) -> Call:
    """``record`` of pixels.c."""
    arguments, about = _sensed(draw)

    def truth() -> tuple[Tensor, Tensor]:
        recorded = _recorded(*arguments)
        return recorded.values, recorded.off

    return Call(about, "record", arguments, arguments[0].numel(), truth)


def sensor_gradient(draw: random.Random) -> Call:
    """``record`` of pixels.c with a gradient."""
    arguments, about = _sensed(draw)
    light, *rest = arguments
    gradient = torch.randn_like(light)

    def truth() -> tuple[Tensor, Tensor]:
        recorded = _recorded(*arguments)
        expected = recorded.slope * gradient.double()
        off = gamma(32, light.dtype) * (1 + recorded.slope.abs()) * gradient.double().abs()
        return expected, torch.where(recorded.torn, torch.inf, off)

    return Call(about, "record", (light, *rest, gradient), light.numel(), truth)


def _sensed(draw: random.Random) -> tuple[tuple[Any, ...], str]:
    """The arguments of ``record``, and what they are in words."""
    light, about = _light(draw)
    fields = [
        random_field(light.shape, dtype=light.dtype) if draw.random() < 0.6 else None
        for random_field in (torch.rand, torch.randn, torch.randn)
    ]
    fields[2] = None if fields[2] is None else 0.1 * fields[2]
    well, sigma = draw.choice((1.0, 40.0, 1e4)), draw.choice((0.01, 0.3))
    numbers = well, draw.choice((0.0, 0.3)) * well, sigma, draw.choice((0, 0, 1, 8, 12)), draw.random() < 0.5
    kinds = [name for name, field in zip(("shot", "read", "offset"), fields, strict=True) if field is not None]
    return (light, *fields, *numbers), f"{about} {kinds} {numbers}"


def _recorded(
    light: Tensor,
    shot: Tensor | None,
    read: Tensor | None,
    offset: Tensor | None,
    well: float,
    dark: float,
    sigma: float,
    bits: int,
    clip: bool,
) -> _Recorded:
    """The formulas of ``pixel_ops.py`` by SciPy's distributions; the rate is rounded as that of the sensor is."""
    share, eps = gamma(24, light.dtype), torch.finfo(light.dtype).eps
    value, slope, torn = light.double(), torch.ones_like(light).double(), torch.zeros_like(light, dtype=torch.bool)
    off = torch.zeros_like(value)
    if shot is not None:
        rate = (light.clamp(min=0) * well + dark).double()
        u, dim = shot.double(), rate < 25
        counts = torch.from_numpy(stats.poisson.ppf(u.clamp(max=1 - 2**-47).numpy(), rate.numpy())).clamp(min=0)
        beside = [(torch.from_numpy(stats.poisson.cdf(counts.numpy() - n, rate.numpy())) - u).abs() for n in (0, 1)]
        unsure = dim & (torch.minimum(*beside) < 1e-12)
        quantile = torch.from_numpy(stats.norm.ppf(u.clamp(eps / 4, 1 - eps / 2).numpy()))
        drawn = rate + rate.sqrt() * quantile
        electrons = torch.where(dim, counts, drawn.clamp(min=0))
        off = torch.where(dim, 0, share * (rate + rate.sqrt() * quantile.abs()))
        slope = torch.where(dim, 1, torch.where(drawn >= 0, 1 + quantile / (2 * rate.clamp(min=25).sqrt()), 0))
        slope = torch.where(light >= 0, slope, 0)
        torn = unsure | (~dim & (drawn.abs() <= off))
        if clip:
            torn = torn | ((electrons - well).abs() <= off) & ~dim
            slope, electrons = torch.where(electrons <= well, slope, 0), electrons.clamp(max=well)
        value = (electrons - dark) / well
        off = torch.where(unsure, torch.inf, (off + share * (electrons + dark)) / well)
    for added in (None if read is None else sigma * read.double(), None if offset is None else offset.double()):
        if added is not None:
            value, off = value + added, off + share * (value.abs() + added.abs())
    if bits:
        top = 2**bits - 1
        level, moved = value * top, off * top + share * (value * top).abs()
        split = ((level - level.floor()) - 0.5).abs() <= moved
        value = level.round() / top
        off = share * value.abs() + torch.where(split, 1.0, 0.0) / top
        torn = torn | split
    if clip:
        torn = torn | ((value.abs() <= off) | ((value - 1).abs() <= off)) & (off > 0)
        slope, value = torch.where((value >= 0) & (value <= 1), slope, 0), value.clamp(0, 1)
    return _Recorded(value, off + share * value.abs(), slope, torn)


def _in_double(case: tuple[Tensor, Tensor, Tensor]) -> list[Tensor]:
    return [x.to(torch.complex128) if x.is_complex() else x.double() for x in case]


def _partially_coherent(draw: random.Random) -> tuple[tuple[Tensor, Tensor, Tensor], str, int]:
    """A field of several states, their weights and kernels; the shapes in words, and the number of products."""
    dtype = draw.choice(DTYPES)
    states, cells, order, depths = draw.randint(1, 6), draw.randint(1, 36), draw.randint(1, 4), draw.randint(1, 4)
    window = draw.choice((1, 2, 3, 4, 5, 9, 22, 33)) if draw.random() < 0.95 else LARGEST_WINDOW
    complex_type = dtype.to_complex()
    field = torch.randn(states, cells, cells, dtype=complex_type)
    kernels = torch.randn(depths, window, order, cells, dtype=complex_type)
    if draw.random() < 0.3:
        kernels = kernels.transpose(1, 2).contiguous().transpose(1, 2)
    weights = torch.rand(states, dtype=dtype)
    about = f"{dtype} states {states} cells {cells} order {order} depths {depths} window {window}"
    return (field, weights, kernels), about, depths * window**2 * cells * (cells + states * order**2)


def _scattered(draw: random.Random) -> tuple[tuple[Any, ...], str, int]:
    """Points of some places on a grid, with a kernel that vanishes at its ends: no rounding moves it there."""
    dtype = draw.choice(DTYPES)
    states, cells, patches, points = draw.randint(1, 6), draw.randint(1, 12), draw.randint(1, 20), draw.randint(1, 18)
    places, depths, shifts, width = draw.randint(1, 2), draw.randint(1, 3), draw.randint(1, 2), draw.randint(2, 8)
    exposures = draw.randint(1, 3)
    phases, amplitudes, window = draw.randint(1, 3), draw.randint(1, 2), draw.choice((1, 3, 5, 9, 23))
    wide = draw.choice((0.0, 0.5, 2.0, 12.0))  # of a patch, in samples of the grid
    extent = 2 * (draw.randint(0, 8) + math.ceil((width + wide + 1) / 2)) + 1
    quarter = draw.randint(1, 14)
    samples = 2 * draw.randint(1, 2 * quarter)
    corners = (width - 1) / 2 + torch.rand(places, 2, patches, 1, dtype=torch.float64) * (extent - width - wide)
    at = corners + wide * torch.rand(places, 2, patches, points, dtype=torch.float64)
    rest = torch.randn(places, phases + amplitudes, patches, points, dtype=torch.float64)
    kernel = torch.rand(draw.randint(2, 9), dtype=dtype)
    kernel[0] = 0
    sums = [torch.randn(places, exposures, shifts, window, samples, dtype=dtype) for _ in range(2)]
    for part in sums:
        part[..., : draw.randint(0, samples)] *= draw.choice((0, 1))
    case = (
        torch.randn(exposures, states, cells, dtype=dtype.to_complex()),
        torch.rand(states, dtype=dtype),
        torch.randint(cells, (patches,)),
        torch.cat([at, rest], 1),
        torch.randn(depths, phases, dtype=torch.float64),
        torch.randn(depths, amplitudes, dtype=torch.float64),
        width,
        kernel,
        torch.randn(quarter, extent // 2 + 1, dtype=dtype),
        torch.randn(quarter, extent // 2 + 1, dtype=dtype),
        *sums,
    )
    about = (
        f"{dtype} exposures {exposures} states {states} cells {cells} patches {patches} points {points} "
        f"places {places} depths {depths} shifts {shifts} width {width} extent {extent} quarter {quarter} "
        f"samples {samples} window {window} wide {wide}"
    )
    transforms = exposures * states * samples * extent * (samples + extent)
    products = places * depths * (patches * points * extent**2 + transforms)
    return case, about, products


KERNELS: dict[str, Callable[[random.Random], Call]] = {
    "overlap.c: gather": overlap_gather,
    "overlap.c: scatter": overlap_scatter,
    "overlap.c: correlate": overlap_correlate,
    "overlap.c: gather over the field": field_gather,
    "overlap.c: scatter over the field": field_scatter,
    "overlap.c: correlate over the field": field_correlate,
    "direct.c: gather": gather,
    "occlusion.c: light": occlude,
    "occlusion.c: gradient": occlude_gradient,
    "occlusion.c: gradient of the light": occlude_light_gradient,
    "occlusion.c: light over the field": field_occlude,
    "occlusion.c: gradient over the field": field_occlude_gradient,
    "occlusion.c: gradient of the light over the field": field_occlude_light_gradient,
    "mutual_intensity.c: energies": energies,
    "mutual_intensity.c: gradient": field_gradient,
    "scattered.c: light": scattered,
    "scattered.c: gradient": scattered_gradient,
    "pixels.c: sRGB": srgb,
    "pixels.c: gradient of sRGB": srgb_gradient,
    "pixels.c: sensor": sensor,
    "pixels.c: gradient of the sensor": sensor_gradient,
}


def _size(draw: random.Random, smallest: int, more: int) -> int:
    """The smallest size a third of the time, and now and then a large one."""
    return smallest + draw.choice((0, draw.randint(0, 3), draw.randint(0, more), draw.randint(0, more)))


def _gathered(draw: random.Random) -> _Scene:
    dtype, products = draw.choice(DTYPES), LARGEST + 1
    while products > LARGEST:
        side = draw.choice((1, 3, 5, 7, 9, 15, 21, 33))
        height, width = _size(draw, gather_ops.STRIP_ROWS, 40), _size(draw, 128 // dtype.itemsize, 70)
        if draw.random() < 0.02:  # more bands or blocks than a piece of a correlation holds
            height, width, side = draw.choice(((290, 33, 3), (7, 1300, 3)))
        images, channels, layers = draw.randint(1, 3), draw.randint(1, 3), draw.randint(1, 8)
        products = images * channels * layers * height * width * side**2
    light = torch.randn(images, channels, height + side - 1, width + side - 1, dtype=dtype)
    memory = draw.choice(("whole", "shared by channels", "cut out", "columns first"))
    if memory == "shared by channels":
        light = light[:, :1].expand(-1, channels, -1, -1)
    elif memory == "cut out":
        light = pad(light, (0, 3, 0, 2))[..., : light.shape[-2], : light.shape[-1]]
    elif memory == "columns first":
        light = light.mT.contiguous().mT
    psfs = torch.randn(layers, channels, side, side, dtype=dtype)
    maps = draw.choice((1, images))
    lower, fraction = (
        x if x is None else x.expand(images, -1, -1) for x in _layers(draw, (maps, height, width), layers, dtype)
    )
    if memory == "columns first":
        lower, fraction = (x if x is None else x.mT.contiguous().mT for x in (lower, fraction))
    about = f"{dtype} light {tuple(light.shape)} {memory} psfs {tuple(psfs.shape)} shared {fraction is not None}"
    return _Scene(light, psfs, lower, fraction, about, products)


def _overlapping(draw: random.Random) -> tuple[_Scene, int, bool]:
    """A scene, the side of windows, and whether PSFs are flipped."""
    scene = _gathered(draw)
    step, side = size_step(scene.light.dtype), scene.psfs.shape[-1]
    sizes = [n for n in range(step, 400, step) if n >= side and is_window_size(n, scene.light.dtype)]
    size = draw.choice(sizes[: draw.choice((1, 4, len(sizes)))])  # small ones, in which tiles are many, more often
    return scene, size, draw.random() < 0.5


def _over_field(draw: random.Random) -> tuple[_Scene, int, bool]:
    """A scene with PSFs at nodes over the field and tiles of any sizes; otherwise as above."""
    scene, size, correlate = _overlapping(draw)
    largest, nodes = size - scene.psfs.shape[-1] + 1, (draw.randint(1, 4), draw.randint(1, 4))
    parts: list[Tensor] = []
    for axis in (0, 1):
        pixels, edges = scene.lower.shape[axis + 1], [0]
        while edges[-1] < pixels:
            edges.append(min(pixels, edges[-1] + draw.choice((largest, largest, draw.randint(1, largest)))))
        middles = torch.tensor(edges[1:], dtype=torch.float64) - 2 * torch.rand(len(edges) - 1, dtype=torch.float64)
        weights = torch.randn(len(edges) - 1, 2, nodes[axis], dtype=torch.float64)
        weights[:, 1] *= draw.choice((0, 0.02, 0.02))
        parts += [torch.tensor(edges), middles, weights]
    psfs = torch.randn(*nodes, *scene.psfs.shape, dtype=scene.psfs.dtype)
    places = Places(*parts)
    about = f"{scene.about} nodes {nodes} tiles {len(parts[1])}x{len(parts[4])}"
    products = math.prod(nodes) * scene.products
    return replace(scene, psfs=psfs, about=about, products=products, places=places), size, correlate


def _listed(scene: _Scene) -> list[Tensor]:
    return [] if scene.places is None else list(scene.places)


def _placed(scene: _Scene, light: Tensor, psfs: Tensor, weights: Tensor) -> Tensor:
    """The definition of PSFs over the field: the pictures of the nodes, each with its weight at each pixel."""
    if scene.places is None:
        return _mixed(light, psfs, weights)
    total: Any = 0
    rows, columns = (
        (own.repeat_interleave(edges.diff(), 0), torch.arange(int(edges[-1])) - middles.repeat_interleave(edges.diff()))
        for edges, middles, own in (scene.places[:3], scene.places[3:])
    )
    for i, own in enumerate(psfs):
        for j, psf in enumerate(own):
            (a, y), (b, x) = (rows[0][..., i].T, rows[1]), (columns[0][..., j].T, columns[1])
            share = (a[0] + y * a[1])[:, None] * b[0] + a[0][:, None] * (x * b[1])
            total = total + share * _mixed(light, psf, weights)
    return total


def _overlap_error(scene: _Scene, light: Tensor, size: int) -> float:
    """Bound what convolution by windows is off by; over the field also by light times its distance from a middle."""
    if (places := scene.places) is None:
        return _transform_error(light, scene.psfs, size)
    rows, columns = (x.abs().amax(0) for x in (places.row_weights, places.column_weights))
    value, y, x = (
        torch.einsum("i,j,ijdcyx->dcyx", rows[m], columns[n], scene.psfs.double().abs())
        for m, n in ((0, 0), (1, 0), (0, 1))
    )
    return 2 * _transform_error(light, value + 2 * size * (y + x), size)


def _pixels(draw: random.Random, scene: _Scene) -> Tensor:
    pixels = torch.randn(len(scene.light), scene.light.shape[1], *scene.lower.shape[-2:], dtype=scene.light.dtype)
    return pixels.mT.contiguous().mT if draw.random() < 0.3 else pixels


def _transform_error(light: Tensor, other: Tensor, size: int) -> float:
    r"""Bound what a convolution by transforms is off by: normwise, as each of its samples is a sum over the window.

    A transform of n samples is off by :math:`\gamma_{c \log_2 n}` of the norm of its input, where a stage of radix 5 or
    less rounds each sample at most c = 24 times (Higham, 24.1). By Cauchy and Schwarz, errors of the two spectra and of
    their product each reach :math:`|x|_2 |h|_2`, those of the transform back :math:`|x|_2 |h|_1`.
    """
    norms = light.double().square().sum((-2, -1)).sqrt().max(), other.double().square().sum((-2, -1)).sqrt().max()
    largest = other.double().abs().sum((-2, -1)).max()
    roundings = 24 * 2 * size.bit_length() + 8
    return float(gamma(roundings, light.dtype) * norms[0] * (3 * norms[1] + largest) * len(light))


def _layers(
    draw: random.Random, shape: tuple[int, int, int], layers: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor | None]:
    """Layers of pixels, and shares of the next ones: both exact where they lie in one layer."""
    maps, height, width = shape
    y, x = torch.arange(height)[:, None], torch.arange(width)
    kind = draw.choice(("one", "noise", "stripes", "squares", "speck"))
    lower = {
        "one": torch.full((height, width), draw.randrange(layers)),
        "noise": torch.randint(layers, (height, width)),
        "stripes": (x % layers).expand(height, width),
        "squares": (y // 11 * 3 + x // 13 * 5) % layers,
        "speck": ((y == height // 2) & (x == width - 1)).long() * (layers - 1),
    }[kind].expand(maps, -1, -1)
    if layers == 1 or draw.random() < 0.5:
        return lower.contiguous(), None
    lower = lower.clamp(max=layers - 2)
    fraction = torch.rand(maps, height, width, dtype=dtype)
    fraction = torch.where(torch.rand(maps, height, width) < draw.random(), fraction.round(), fraction)
    return lower.contiguous(), fraction


def _weights(scene: _Scene, *, gradient: bool = False) -> Tensor:
    """(B, D, H, W) weights of each layer, or their derivatives with respect to the layer weight."""
    layers = scene.psfs.shape[-4]
    lower = one_hot(scene.lower, layers + 1).movedim(-1, 1).double()
    upper = one_hot(scene.lower + 1, layers + 1).movedim(-1, 1).double()
    if gradient:
        return (upper - lower)[:, :layers]
    fraction = torch.zeros(()) if scene.fraction is None else scene.fraction[:, None].double()
    return ((1 - fraction) * lower + fraction * upper)[:, :layers]


def _mixed(light: Tensor, psfs: Tensor, weights: Tensor) -> Tensor:
    """The definition: a convolution of the whole plane for each layer, and their weighted sum."""
    layers, channels = psfs.shape[:2]
    kernels = psfs.flip((-2, -1)).transpose(0, 1).flatten(0, 1)[:, None]
    blurred = conv2d(light, kernels, groups=channels).unflatten(1, (channels, layers))
    return torch.einsum("bcdhw,bdhw->bchw", blurred, weights)


def _magnitudes(x: Tensor) -> Tensor:
    return x.double().abs()
