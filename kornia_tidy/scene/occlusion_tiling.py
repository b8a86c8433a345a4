"""Exact occlusion by tiles: of each tile's window, only the layers found there are blurred and laid over one another.

A tile of T x T pixels sees a window of ``size = T + P - 1``. A layer absent from the window has neither light nor
opacity there, so leaving it out changes nothing. What remains is made cheap:

- Light and weight of a layer go through the PSF together, as the real and imaginary part of one complex plane.
- The nearest layer of a window is seen against all of it, so its divisor is the sum of its PSF; the farthest one only
  against itself, so its divisor is its own blurred weight. Only layers between the two need a third plane.
- A window of a single layer, the common case, hides nothing: it is one convolution in the image's own precision, two
  windows of like layers in one complex plane.

Tiles with as many layers as each other are worked on together, in chunks of bounded memory. For the backward pass only
the inputs are kept; each chunk is computed again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from kornia_tidy.scene.convolution import next_fast_size, pad_border
from kornia_tidy.scene.layers import layer_weight
from kornia_tidy.scene.occlusion import EPSILON, lay_over, weight_behind

# Sides of transforms; and bytes that the complex planes of a chunk may take, see tiles.py.
SIZES = (16, 24, 32, 36, 48, 64, 72, 96, 128, 144, 192, 256, 288, 384, 512, 768, 1024)
CHUNK_BYTES = {"cpu": 6 << 20}
CHUNK_BYTES_ACCELERATOR = 256 << 20

Corner = tuple[int, int, int]  # image, first row and first column of a window in the padded plane, and of its tile


class Grid(NamedTuple):
    """Square tiles over a batch of images of ``height`` x ``width`` pixels, the last ones reaching beyond."""

    batch: int
    height: int
    width: int
    size: int
    tile: int

    @property
    def rows(self) -> int:
        """Tiles from top to bottom."""
        return math.ceil(self.height / self.tile)

    @property
    def columns(self) -> int:
        """Tiles from left to right."""
        return math.ceil(self.width / self.tile)

    def corner(self, number: int) -> Corner:
        """Return where a tile stands."""
        rest, column = divmod(number, self.columns)
        image, row = divmod(rest, self.rows)
        return image, row * self.tile, column * self.tile


class Chunk(NamedTuple):
    """Tiles that are worked on together, all with n layers in their windows.

    Args:
        corners: where they stand.
        layers: (N, n) their layers from far to near, as indices into :attr:`Plan.present`.
        bounded: nothing of the windows lies in the dark beyond a border of zeros.
        fillers: where in ``corners`` a tile stands only to make a pair and counts for nothing.
    """

    corners: list[Corner]
    layers: Tensor
    bounded: bool
    fillers: list[int]


class Plan(NamedTuple):
    """What is computed for one scene: tiles in chunks, and the (D',) layers that are present at all."""

    grid: Grid
    present: Tensor
    chunks: list[Chunk]


class Scene(NamedTuple):
    """Planes that windows are cut from, and what their layers are blurred by.

    Args:
        light: (B, C, H', W') image, with all that lies beyond its border and below and right of its tiles.
        spectra: (D', C, size, size) complex128 spectra of the PSFs of the layers present.
        lower: (B, H', W') index of each pixel's layer.
        fraction: (B, H', W') share of the next layer, or None.
        inside: (1, H', W') 1 on the image and 0 in the dark beyond it, or None for no dark.
        mean: (B, C) mean light of each image, and
        veil: (D', C) how much of it each layer takes on; or None.
    """

    light: Tensor
    spectra: Tensor
    lower: Tensor
    fraction: Tensor | None
    inside: Tensor | None
    mean: Tensor | None
    veil: Tensor | None


class Inputs(NamedTuple):
    """What a chunk's tiles are a differentiable function of: windows of the scene, and spectra of their layers."""

    light: Tensor  # (N, C, size, size)
    spectra: Tensor  # (N, n, C, size, size), or (N / 2, C, size, size) for pairs of one layer
    fraction: Tensor | None  # (N, size, size)
    mean: Tensor | None  # (N, C)
    veil: Tensor | None  # as spectra, without the size


def occlude_tiled(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    """Render with occlusion, tile by tile. See :func:`kornia_tidy.scene.occlusion.occlude_dense`, which it equals.

    It has gradients with respect to image, psfs, fraction and veil, but no second ones.
    """
    batch, _, height, width = image.shape
    psf_size = psfs.shape[-1]
    if border == "valid":
        height, width = height - psf_size + 1, width - psf_size + 1
    sloped = fraction is not None and fraction.requires_grad and torch.is_grad_enabled()

    # Black beyond the border has no weight; let it lie in layers that are there anyway.
    sides = "replicate" if border == "zero" else border
    lower = pad_border(lower.to(image.dtype), psf_size // 2, sides)
    fraction = None if fraction is None else pad_border(fraction, psf_size // 2, sides)
    plan = make_plan(
        lower[:, 0].long().expand(batch, -1, -1),
        None if fraction is None else fraction[:, 0].detach().expand(batch, -1, -1),
        (height, width),
        (len(psfs), image.shape[1], psf_size),
        sloped=sloped,
        dark=border == "zero",
    )
    grid = plan.grid
    rest = (0, grid.columns * grid.tile - width, 0, grid.rows * grid.tile - height)  # no new layers: nothing to compute
    light = pad(pad_border(image, psf_size // 2, border), rest, mode="replicate")
    inside = pad_border(torch.ones_like(image[:1, :1]), psf_size // 2, "zero") if border == "zero" else None
    return _OccludeTiled.apply(
        light,
        psfs,
        None if fraction is None else pad(fraction, rest, mode="replicate")[:, 0].expand(batch, -1, -1),
        None if veil is None else image.mean((-2, -1)),
        veil,
        pad(lower, rest, mode="replicate")[:, 0].long().expand(batch, -1, -1),
        None if inside is None else pad(inside, rest, mode="replicate")[0],
        plan,
    )


def make_plan(
    lower: Tensor,
    fraction: Tensor | None,
    output: tuple[int, int],
    bank: tuple[int, int, int],
    *,
    sloped: bool,
    dark: bool,
) -> Plan:
    """Choose the tiles for a scene, find the layers of each, and group them into chunks.

    Args:
        lower: (B, H, W) layer of each pixel of the padded image, and
        fraction: share of the next one, or None.
        output: height and width of the image to be made.
        bank: number of layers, channels and the side of the PSFs.
        sloped: a share of zero matters too, for its gradient.
        dark: what lies beyond the border has no weight.
    """
    count, channels, psf_size = bank
    labels = _labels(lower, fraction, sloped=sloped)
    grid = choose_grid(labels, output, count, psf_size)
    here = _present(labels, grid, count, 1).cpu()
    used = here.any(0)
    here = here[:, used]
    radius = psf_size // 2 if dark else 0
    corners = [grid.corner(number) for number in range(len(here))]
    bounded = torch.tensor(
        [
            radius <= y <= grid.height + radius - grid.size and radius <= x <= grid.width + radius - grid.size
            for _, y, x in corners
        ]
        if dark
        else [True] * len(here)
    )
    numbers = here.sum(1)
    limit = CHUNK_BYTES.get(lower.device.type, CHUNK_BYTES_ACCELERATOR) // (16 * channels * grid.size**2)
    chunks = []
    for own_bound in (True, False):
        for number in range(1, int(numbers.max()) + 1):
            tiles = ((numbers == number) & (bounded == own_bound)).nonzero().squeeze(-1)
            layers = here[tiles].nonzero()[:, 1].view(-1, number)
            pairs = own_bound and number == 1
            if pairs:
                tiles, layers = _paired(tiles, layers)
            step = max(2, limit // number // 2 * 2)
            for first in range(0, len(tiles), step):
                own = tiles[first : first + step].tolist()
                chunks.append(
                    Chunk(
                        [corners[max(tile, 0)] for tile in own],
                        layers[first : first + step].to(lower.device),
                        own_bound,
                        [place for place, tile in enumerate(own) if tile < 0],
                    )
                )
    return Plan(grid, used.nonzero().squeeze(-1).to(lower.device), chunks)


def choose_grid(labels: list[Tensor], output: tuple[int, int], count: int, psf_size: int) -> Grid:
    """Return the grid with the lowest cost.

    Larger tiles waste less on their overlap, smaller ones hold fewer layers. The layers of each candidate are counted
    on every eighth row and column. Cost in nanoseconds a sample of a window and channel, measured on one core of a
    2.5 GHz Xeon: 3 for a window of a single layer in float32; of n layers, 13 each, and 8 for each but two.
    """
    batch = len(labels[0])
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: a window meets only next neighbours
    sizes = [size for size in SIZES if smallest <= size < 2 * (psf_size - 1 + max(output))][:5]
    grids = [Grid(batch, *output, size, size - psf_size + 1) for size in sizes or [next_fast_size(smallest)]]
    step = 8
    sample = [label[:, ::step, ::step] for label in labels]
    costs = []
    for grid in grids:
        number = _present(sample, grid, count, step).sum(1)
        cost = torch.where(number < 2, 3, 13 * number + 8 * (number - 2))
        costs.append(cost.sum() * grid.size**2)
    return grids[int(torch.stack(costs).argmin())]


def _labels(lower: Tensor, fraction: Tensor | None, *, sloped: bool) -> list[Tensor]:
    """Return the one or two layers of each pixel."""
    if fraction is None:
        return [lower]
    if sloped:
        return [lower, lower + 1]
    return [lower + (fraction == 1), lower + (fraction > 0)]


def _present(labels: list[Tensor], grid: Grid, count: int, step: int) -> Tensor:
    """Return (tiles, count) bool: the layers in each tile's window. Labels are of every ``step``-th pixel.

    A pixel belongs to the window of the tile it lies in, and to that of the tile before if it lies near the start.
    """
    batch, height, width = labels[0].shape
    device = labels[0].device

    def windows(length: int, tiles: int) -> tuple[Tensor, Tensor]:
        """The window that each row begins in; and which rows the window before reaches as well."""
        pixel = step * torch.arange(length, device=device)
        own = (pixel // grid.tile).clamp(max=tiles - 1)
        return own, ((pixel - own * grid.tile < grid.size - grid.tile) & (own > 0)).nonzero().squeeze(-1)

    (row, reached_rows), (column, reached_columns) = windows(height, grid.rows), windows(width, grid.columns)
    first = torch.arange(batch, device=device)[:, None, None] * (grid.rows * grid.columns * count)
    table = torch.zeros(batch * grid.rows * grid.columns * count, dtype=torch.bool, device=device)
    for label in labels:
        own = label + first + ((row * grid.columns)[:, None] + column) * count
        above = own[:, reached_rows] - grid.columns * count
        for keys in (own, own[..., reached_columns] - count, above, above[..., reached_columns] - count):
            table.index_fill_(0, keys.reshape(-1), True)
    return table.view(-1, count)


def _paired(tiles: Tensor, layers: Tensor) -> tuple[Tensor, Tensor]:
    """Order tiles of one layer each so that two of a layer stand together; -1 fills up where one is left over."""
    order = layers[:, 0].argsort(stable=True)
    own = layers[order, 0]
    numbers = torch.bincount(own)
    even = numbers + numbers % 2
    shift = (even.cumsum(0) - even) - (numbers.cumsum(0) - numbers)
    slots = torch.arange(len(own)) + shift[own]
    filled = torch.full((int(even.sum()),), -1)
    filled[slots] = tiles[order]
    return filled, torch.arange(len(numbers)).repeat_interleave(even)[:, None]


class _OccludeTiled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        light: Tensor,
        psfs: Tensor,
        fraction: Tensor | None,
        mean: Tensor | None,
        veil: Tensor | None,
        lower: Tensor,
        inside: Tensor | None,
        plan: Plan,
    ) -> Tensor:
        ctx.save_for_backward(light, psfs, fraction, mean, veil, lower, inside)
        ctx.plan = plan
        scene = _scene(light, psfs, fraction, mean, veil, lower, inside, plan)
        grid = plan.grid
        coded = light.new_empty(*light.shape[:2], grid.height, grid.width)
        for chunk in plan.chunks:
            tiles = _tiles(_inputs(scene, chunk, grid), scene, chunk, plan)
            for place, (image, y, x) in _kept(chunk):
                part = coded[image, :, y : y + grid.tile, x : x + grid.tile]
                part.copy_(tiles[place, :, : part.shape[-2], : part.shape[-1]])
        return coded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        light, psfs, fraction, mean, veil, lower, inside = ctx.saved_tensors
        plan: Plan = ctx.plan
        grid = plan.grid
        scene = _scene(light, psfs, fraction, mean, veil, lower, inside, plan)
        grad = pad(grad, (0, grid.columns * grid.tile - grid.width, 0, grid.rows * grid.tile - grid.height))
        sources = Inputs(light, scene.spectra, fraction, mean, scene.veil)
        wanted = Inputs(*ctx.needs_input_grad[:5])
        slopes = Inputs(*(torch.zeros_like(s) if want else None for s, want in zip(sources, wanted, strict=True)))
        for chunk in plan.chunks:
            own = torch.stack([grad[i, :, y : y + grid.tile, x : x + grid.tile] for i, y, x in chunk.corners])
            own[chunk.fillers] = 0
            with torch.enable_grad():
                inputs = Inputs(
                    *(
                        None if x is None else x.detach().requires_grad_(want)
                        for x, want in zip(_inputs(scene, chunk, grid), wanted, strict=True)
                    )
                )
                tiles = _tiles(inputs, scene, chunk, plan)
                asked = [place for place, x in enumerate(inputs) if x is not None and x.requires_grad]
                found = torch.autograd.grad(tiles, [inputs[place] for place in asked], own.to(tiles.dtype))
            _add(Inputs(*(found[asked.index(n)] if n in asked else None for n in range(5))), slopes, chunk, grid)
        side = psfs.shape[-1]
        of_psfs = of_veil = None
        if slopes.spectra is not None:  # correlation is the transpose of convolution
            of_psfs = torch.zeros_like(psfs)
            own = torch.fft.ifft2(slopes.spectra, norm="forward").real[..., :side, :side]
            of_psfs[plan.present] = own.to(psfs.dtype)
        if slopes.veil is not None:
            of_veil = torch.zeros_like(veil)
            of_veil[plan.present] = slopes.veil
        return slopes.light, of_psfs, slopes.fraction, slopes.mean, of_veil, None, None, None


def _scene(
    light: Tensor,
    psfs: Tensor,
    fraction: Tensor | None,
    mean: Tensor | None,
    veil: Tensor | None,
    lower: Tensor,
    inside: Tensor | None,
    plan: Plan,
) -> Scene:
    spectra = torch.fft.fft2(psfs.index_select(0, plan.present).double(), s=(plan.grid.size, plan.grid.size))
    veil = None if veil is None else veil.index_select(0, plan.present)
    return Scene(light, spectra, lower, fraction, inside, mean, veil)


def _cut(planes: Tensor, chunk: Chunk, grid: Grid) -> Tensor:
    """Cut a chunk's windows out of (B, ..., H', W')."""
    size = grid.size
    return torch.stack([planes[image, ..., y : y + size, x : x + size] for image, y, x in chunk.corners])


def _kept(chunk: Chunk) -> Iterator[tuple[int, Corner]]:
    """The tiles that count."""
    for place, corner in enumerate(chunk.corners):
        if place not in chunk.fillers:
            yield place, corner


def _alone(chunk: Chunk) -> bool:
    """Whether each window is all of one layer, and tiles stand in pairs."""
    return chunk.bounded and chunk.layers.shape[1] == 1


def _inputs(scene: Scene, chunk: Chunk, grid: Grid) -> Inputs:
    alone = _alone(chunk)
    layers = chunk.layers[::2, 0] if alone else chunk.layers
    images = [image for image, _, _ in chunk.corners]
    return Inputs(
        _cut(scene.light, chunk, grid),
        scene.spectra.index_select(0, layers.flatten()).unflatten(0, layers.shape),
        None if alone or scene.fraction is None else _cut(scene.fraction, chunk, grid),
        None if scene.mean is None else scene.mean[images],
        None if scene.veil is None else scene.veil[layers],
    )


def _add(found: Inputs, slopes: Inputs, chunk: Chunk, grid: Grid) -> None:
    """Add the gradients of a chunk's inputs to those of what they were taken from."""
    size = grid.size
    for part, plane in ((found.light, slopes.light), (found.fraction, slopes.fraction)):
        if part is not None and plane is not None:
            for own, (image, y, x) in zip(part, chunk.corners, strict=True):
                plane[image, ..., y : y + size, x : x + size] += own
    layers = chunk.layers[::2, 0] if _alone(chunk) else chunk.layers.flatten()
    for part, table in ((found.spectra, slopes.spectra), (found.veil, slopes.veil)):
        if part is not None and table is not None:
            table.index_add_(0, layers, part.reshape(-1, *table.shape[1:]))
    if found.mean is not None and slopes.mean is not None:
        images = torch.tensor([image for image, _, _ in chunk.corners], device=slopes.mean.device)
        slopes.mean.index_add_(0, images, found.mean)


def _tiles(inputs: Inputs, scene: Scene, chunk: Chunk, plan: Plan) -> Tensor:
    """Return a chunk's tiles, (N, C, tile, tile)."""
    return _pairs_of_one_layer(inputs, plan.grid) if _alone(chunk) else _layers_over(inputs, scene, chunk, plan)


def _pairs_of_one_layer(inputs: Inputs, grid: Grid) -> Tensor:
    light, spectra = inputs.light.unflatten(0, (-1, 2)), inputs.spectra  # (N / 2, 2, C, ...) and (N / 2, C, ...)
    if inputs.veil is not None and inputs.mean is not None:
        mean, veil = inputs.mean.unflatten(0, (-1, 2)), inputs.veil[:, None]
        light = torch.lerp(light, mean[..., None, None], veil[..., None, None])
    both = torch.complex(light[:, 0], light[:, 1])
    blurred = torch.fft.ifft2(torch.fft.fft2(both) * spectra.to(both.dtype))
    divisor = spectra[..., :1, :1].real.to(light.dtype) + EPSILON  # the sum of the PSF
    start = grid.size - grid.tile
    blurred = torch.view_as_real(blurred[..., start:, start:]).movedim(-1, 1) / divisor[:, None]
    return blurred.flatten(0, 1)


def _layers_over(inputs: Inputs, scene: Scene, chunk: Chunk, plan: Plan) -> Tensor:
    grid = plan.grid
    start, count = grid.size - grid.tile, chunk.layers.shape[1]
    index = plan.present[chunk.layers][..., None, None]
    lower = _cut(scene.lower, chunk, grid)[:, None]
    fraction = None if inputs.fraction is None else inputs.fraction[:, None].double()
    # The nearest layer is seen against all of the window, the farthest one against itself; these need a plane.
    between = slice(1, count - 1 if chunk.bounded else count)
    own = layer_weight(lower, fraction, index).double()
    behind = weight_behind(lower, fraction, index[:, between]).double()
    if scene.inside is not None:
        inside = torch.stack([scene.inside[0, y : y + grid.size, x : x + grid.size] for _, y, x in chunk.corners])
        own, behind = own * inside[:, None], behind * inside[:, None]

    light = inputs.light[:, None].double()
    if inputs.veil is not None and inputs.mean is not None:
        light = torch.lerp(light, inputs.mean[:, None, :, None, None].double(), inputs.veil[..., None, None].double())
    lit = torch.complex(light, torch.ones_like(light))  # times a weight: the layer's light, and the weight itself
    spectra = torch.fft.fft2(own[:, :, None].to(lit.dtype) * lit)
    spectra = spectra * inputs.spectra if torch.is_grad_enabled() else spectra.mul_(inputs.spectra)
    blurred = torch.fft.ifft2(spectra)[..., start:, start:]

    seen = [blurred.imag[:, 0]]
    if behind.shape[1]:
        spectra = torch.fft.rfft2(behind)[:, :, None] * inputs.spectra[:, between, ..., : grid.size // 2 + 1]
        seen += torch.fft.irfft2(spectra, s=(grid.size, grid.size))[..., start:, start:].unbind(1)
    if chunk.bounded:
        seen.append(inputs.spectra[:, -1, :, :1, :1].real)  # the sum of the PSF
    return lay_over((blurred.real[:, d], blurred.imag[:, d], seen[d]) for d in reversed(range(count)))
