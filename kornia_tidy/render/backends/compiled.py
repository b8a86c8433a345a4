"""The compiled backend: gather, scatter and occlusion in C, on processors.

Small PSFs are convolved sample by sample and discs run by run (``direct.c``), other ones by transforms of overlapping
windows (``overlap.c``), each block or window with only the PSFs of its layers. Occlusion is convolved directly
(``occlusion.c``): all that is added up is positive, so float32 is enough, as the relative error of every sum is small,
however small the normaliser that it becomes. Gradients of image, PSFs and stray light are made in the same way, that of
depth by :mod:`~kornia_tidy.render.backends.batched`. See :mod:`kornia_tidy.kernels.build`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from kornia_tidy.kernels import gather_ops, occlusion_ops, overlap_ops
from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.gather_ops import count_terms, gather_direct
from kornia_tidy.kernels.occlusion_ops import occlusion_direct, occlusion_direct_gradients
from kornia_tidy.kernels.overlap_ops import gather_overlap, overlap_psf_gradient, scatter_overlap, window_size
from kornia_tidy.render.backend import GradientPairs, Work, transform_operations, wants_gradient
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.batched import BatchedBackend
from kornia_tidy.render.backends.dense import DenseBackend
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.layer_sums import LayerSums, blend_gradients, present_in_tiles, seen
from kornia_tidy.render.scene import SAMPLE, LayeredScene

# With this limit and windows of 2.5 P (`window_size`) gather and scatter took 1.04 times the time of the best choice
# in the geometric mean of 39 scenes, 1.30 times at most: an AMD EPYC, one thread, tests/benchmarks/dispatch_regret.py.
LARGEST_DIRECT = 5  # px
NEGATIVE = 1e-4  # of a PSF: over EPSILON it makes a float32's round-off 1e-5
# Operations for each sample of a window, as many as take as long: to cut it out and to write its tile, and for each
# layer to multiply by a spectrum and to add up.
_TILE, _PAIR = 100, 14
_WINDOW = 1e5  # for each window beside those of its samples: the extra time of small ones
_WINDOW_PLANES = 7  # of a thread: light, labels, weights and sums of a window, two spectra, and one on its way back
_OF_FIELD = 6  # the same over the field: spectra of a PSF and of light, each with two gradients


class CompiledBackend:
    """Rendering in C. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "compiled"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why a scene cannot be rendered in C, or None if it can."""
        image, occludes = scene.image, scene.compositing == "occlusion"
        if image.device.type != "cpu":
            return f"it runs on processors, and the image is on {image.device.type!r}"
        if image.dtype not in REALS:
            return f"it computes in float32 or float64, and the image is in {image.dtype}"
        sources = [occlusion_ops.SOURCE] if occludes else [gather_ops.SOURCE, overlap_ops.SOURCE]
        if any(compiled(source, image.dtype) is None for source in sources):
            return "it needs a C compiler (see `kornia-tidy info`)"
        if not occludes:
            return None
        if not _fits(scene, smallest := occlusion_ops.smallest_output(image.dtype)):
            least, size = ("x".join(map(str, sides)) for sides in (smallest, scene.output_size))
            return f"its occlusion needs an output of at least {least} pixels, got {size}"
        psfs = scene.psfs.detach()
        lowest = float(psfs.min())
        if lowest < 0:
            lowest = float(psfs.clamp(max=0).sum((-2, -1)).min())
        if lowest < -NEGATIVE:  # sums keep their relative accuracy only where all terms are positive
            return (
                f"its occlusion needs PSFs without negative values, got one with {lowest:.1e} of its light below zero"
            )
        return None

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        if scene.compositing == "occlusion":
            return occlusion_direct(*_occlusion(scene))
        sums = _Sums(scene)
        if scene.compositing == "gather":
            return sums.gather(scene.plane)
        return seen(scene, sums.scatter(scene.plane))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the padded planes, of the PSFs and of the layer weight."""
        keep_memory()
        if scene.compositing == "occlusion":
            return _occlusion_gradients(scene, gradient)
        return blend_gradients(scene, cast("LayerSums", _Sums(scene)), gradient)

    def work(self, scene: LayeredScene) -> Work:
        """Return the work: of occlusion as the C code counts it, of windows with the layers in a sample of pixels."""
        labels, (batch, channels), side = scene.labels, scene.image.shape[:2], scene.psfs.shape[-1]
        pixels, itemsize = batch * scene.output_size[0] * scene.output_size[1], scene.image.element_size()
        image, words, terms = channels * labels.layer_index.numel() * itemsize, channels * itemsize // 4, 1
        if scene.field is not None:  # a tile's PSF has its value and as many as two gradients
            terms += sum(bool(x[:, 1].any()) for x in (scene.places.row_weights, scene.places.column_weights))
        if scene.compositing == "occlusion":
            one = scene.psfs if scene.field is None else scene.psfs[0]
            operations, tables = words * occlusion_ops.count_operations(*scene.sorted_layers, one, batch), 0
            if scene.field is not None:  # each block makes its PSFs
                operations *= 1.5 * terms
                tables = 2 * one.numel() * scene.field.nodes[1] * itemsize * torch.get_num_threads()
            return Work(operations, 2 * image + 32 * labels.layer_index.numel() + tables)
        kept = 16 * labels.layer_index.numel()
        if direct := _Sums(scene).terms:
            blended = 1 if labels.layer_weight is None else 2
            return Work(2 * blended * words * pixels * direct, 2 * image + kept)
        height, width = labels.layer_index.shape[1:]
        sides, threads = (window_size(side), window_size(side)), torch.get_num_threads()
        if scene.field is not None:
            edges = scene.places.row_edges, scene.places.column_edges
            sides = int(edges[0].diff().max()) + side - 1, int(edges[1].diff().max()) + side - 1
        tile, samples = (sides[0] - side + 1, sides[1] - side + 1), sides[0] * sides[1]
        rows, columns = -(-height // tile[0]), -(-width // tile[1])
        present = present_in_tiles(labels.every(SAMPLE), tile, scene.psfs.shape[-4], step=SAMPLE)
        blocks, pairs, layers = batch * rows * columns, int(present.sum()), int(present.any(0).sum())
        transforms, planes, sums = blocks + pairs + layers, layers + _WINDOW_PLANES * threads, 0
        if scene.field is not None:  # light in each tile, PSFs in each pair, and x and y times both
            down, across = scene.field.nodes
            transforms, planes = terms * blocks + (terms + 1) * pairs, (_WINDOW_PLANES + _OF_FIELD) * threads
            sums = terms * 2 * side**2 * across * (pairs + 2 * down * layers * rows)
            kept += 2 * across * layers * side**2 * itemsize * threads
            pairs *= terms
        operations = transform_operations(*sides) * transforms + _WINDOW * blocks + sums
        operations = words * (operations + samples * (_TILE * blocks + _PAIR * pairs))
        return Work(operations, planes * itemsize * samples + 3 * image + kept, max(sides))


class _Sums:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`."""

    def __init__(self, scene: LayeredScene) -> None:
        psfs, self.index, self.weight = scene.psfs.detach(), scene.labels.layer_index, scene.labels.layer_weight
        self.size, self.places, self.terms = window_size(psfs.shape[-1]), (), 0
        if scene.field is not None:
            psfs, self.places = psfs.unflatten(0, scene.field.nodes), scene.places
        elif scene.compositing == "gather":
            count, side, terms = psfs.shape[0] * psfs.shape[1], psfs.shape[-1], 0
            if side <= LARGEST_DIRECT:
                terms = side**2
            # Most pairs of neighbours in the middle of a disc are equal, and none in that of other PSFs. Where only
            # work is counted, PSFs are one expanded number.
            elif psfs.stride(-1) and 2 * int(psfs[..., side // 2].diff().count_nonzero()) <= count * side:
                terms = -(-count_terms(psfs) // count)
            if terms and (side <= LARGEST_DIRECT or 2 * terms <= side**2):
                self.terms = terms * _fits(scene, gather_ops.smallest_output(scene.image.dtype))
        given: dict[str, Any] = {"psfs": psfs, "layer_index": self.index, "layer_weight": self.weight}
        windows = {**given, "size": self.size, "places": self.places}
        self.layers = psfs.shape[-4]
        self.gather = partial(gather_direct, **given) if self.terms else partial(gather_overlap, **windows)
        self.scatter = partial(scatter_overlap, **windows)

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        given = plane, pixels, self.index, self.weight, self.layers, self.size
        found = overlap_psf_gradient(*given, correlate=correlate, places=self.places)
        return found.flatten(0, 1) if self.places else found


def _occlusion_gradients(scene: LayeredScene, gradient: Tensor) -> GradientPairs:
    """Return the gradients directly; with those of depth all by transforms."""
    planes = _occlusion(scene)
    light, psfs, _, weight, mean, stray_light, *_ = planes
    tensors = light, psfs, mean, stray_light
    wanted = [wants_gradient(x) for x in tensors]
    if wants_gradient(weight):
        return (BatchedBackend() if scene.field is None else DenseBackend()).gradients(scene, gradient)
    with torch.no_grad():
        found = occlusion_direct_gradients(*planes, gradient, wanted)
    return list(zip((x for x, want in zip(tensors, wanted, strict=True) if want and x is not None), found, strict=True))


def _occlusion(scene: LayeredScene) -> tuple[Any, ...]:
    """Return the arguments of :func:`occlusion_direct`."""
    light, psfs, weight, mean, stray_light, index, inside = occlusion_planes(scene)
    if scene.field is None:
        return light, psfs, index, weight, mean, stray_light, inside, ()
    return light, psfs.unflatten(0, scene.field.nodes), index, weight, mean, stray_light, inside, scene.places


def _fits(scene: LayeredScene, smallest: tuple[int, int]) -> bool:
    """Return whether the output is at least a block large."""
    return all(side >= least for side, least in zip(scene.output_size, smallest, strict=True))
