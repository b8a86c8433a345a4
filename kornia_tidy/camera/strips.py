"""Large pictures: a capture that would not fit the memory allowed is taken some rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from torch import Tensor

from kornia_tidy.camera.samples import BYTES_A_VALUE, BYTES_OF_TILES, Sample
from kornia_tidy.kernels.occlusion_ops import BLOCK_ROWS
from kornia_tidy.psf.field import Field
from kornia_tidy.render.borders import extended
from kornia_tidy.sensor.sensor import STRIP


@dataclass(frozen=True, eq=False)
class Strip:
    """Rows of a capture, with the light and the defocus that they are seen from.

    Args:
        light: (B, C, H, W) linear, in the type that the capture is computed in.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        reach: lowest and highest defocus of all rows in radians, (2,), or their map.
        border: continuation of the light beyond its edges: ``"valid"`` where it reaches as far as the PSFs.
        rows: of the capture. Default: all.
        fields: of the whole picture, behind a real lens, and where in it the light begins: one, or one for each image.
    """

    light: Tensor
    defocus: Tensor
    reach: Tensor
    border: str
    rows: slice | None = None
    fields: tuple[Field, ...] = ()

    def images(self) -> Iterator[Strip]:
        """Yield the images of the batch one by one, each at its place of the field."""
        for i, field in enumerate(self.fields):
            light, defocus = (x[i : i + 1] if len(x) > 1 else x for x in (self.light, self.defocus))
            yield replace(self, light=light, defocus=defocus, fields=(field,))


def rows_at_once(sample: Sample, allowed: int) -> int | None:
    """Return how many rows of a capture fit into so many bytes; None for all.

    It is a multiple of the rows of one noise draw.

    Args:
        sample: image and depth.
        allowed: bytes beside image and capture.
    """
    batch, _, height, width = sample.image.shape
    row = 3 * BYTES_A_VALUE * sample.dtype.itemsize // 4 * batch * width
    rows = max(STRIP, (allowed - BYTES_OF_TILES) // row // STRIP * STRIP)
    return None if rows >= height else rows


def strips_of(
    sample: Sample, rows: int, height: int, radius: int, border: str, fields: tuple[Field, ...]
) -> Iterator[tuple[slice, Tensor, Tensor, tuple[Field, ...]]]:
    """Yield the rows of each strip of a capture, the image and the depth that they are seen from, and their fields.

    Args:
        sample: image and depth.
        rows: of a strip; the last one may have some more.
        height: of the capture.
        radius: of the PSFs: how far the image of a strip reaches beyond it, to be rendered with the border ``"valid"``.
        border: of the capture.
        fields: of the pictures, behind a real lens.
    """
    sides = "replicate" if border == "zero" else border  # black has no depth
    before = 0 if border == "valid" else radius
    columns = -before, sample.image.shape[-1] + before
    tops = range(0, max(1, height - BLOCK_ROWS + 1), rows)  # what is left may be too low for compiled occlusion
    for top, end in zip(tops, [*tops[1:], height], strict=True):
        seen = top - before, end - before + 2 * radius
        image = extended(sample.image, seen, columns, border).to(sample.dtype)
        depth = extended(sample.depth, seen, columns, sides).to(sample.dtype)
        yield slice(top, end), image, depth, tuple(field.moved(top - before, -before) for field in fields)


def placed(whole: Tensor | None, part: Tensor, rows: slice, height: int) -> Tensor:
    """Return a picture with some of its rows filled in.

    Args:
        whole: the picture so far; None before its first rows, which come first.
        part: (B, C, rows, W).
        rows: where they belong.
        height: of the picture.
    """
    if whole is None:
        whole = part.new_empty(*part.shape[:-2], height, part.shape[-1])
    whole[..., rows, :] = part
    return whole
