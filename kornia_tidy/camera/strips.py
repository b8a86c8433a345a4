"""Large pictures: a capture that would not fit the memory allowed is taken some rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from kornia_tidy.camera.samples import BYTES_A_VALUE, BYTES_OF_TILES, Sample
from kornia_tidy.psf.field import Field
from kornia_tidy.render.bands import padded_band
from kornia_tidy.sensor.sensor import STRIP


@dataclass(frozen=True, eq=False)
class Strip:
    """Rows of a capture, with the image and the depth that they are seen from.

    Args:
        image: (B, C, H, W) in the camera's colour space, in the type that the capture is computed in.
        depth: (B, 1, H, W) or (1, 1, H, W).
        border: what lies beyond the image: ``"valid"`` where it reaches as far as the PSFs.
        rows: of the capture. Default: all.
        reach: lowest and highest defocus of all rows, (2,). Default: to be found.
        fields: of the whole picture, behind a real lens, and where in it this image begins: one, or one for each image.
    """

    image: Tensor
    depth: Tensor
    border: str
    rows: slice | None = None
    reach: Tensor | None = None
    fields: tuple[Field, ...] = ()

    def by_field(self) -> dict[Field | None, list[int]]:
        """Return the images of the batch that lie at each place of the field; none of them: all."""
        if len(self.fields) < 2:
            return {self.fields[0] if self.fields else None: []}
        places: dict[Field | None, list[int]] = {}
        for i, field in enumerate(self.fields):
            places.setdefault(field, []).append(i)
        return places if len(places) > 1 else {self.fields[0]: []}


def rows_at_once(sample: Sample, allowed: int) -> int | None:
    """Return how many rows of a capture fit into so many bytes; None for all.

    It is a multiple of those that noise is drawn for at once.

    Args:
        sample: image and depth.
        allowed: bytes beside image and capture.
    """
    batch, _, height, width = sample.image.shape
    row = 3 * BYTES_A_VALUE * sample.dtype.itemsize // 4 * batch * width
    rows = max(STRIP, (allowed - BYTES_OF_TILES) // row // STRIP * STRIP)
    return None if rows >= height else rows


def strips_of(
    sample: Sample, rows: int, height: int, radius: int, border: str, reach: Tensor, fields: tuple[Field, ...]
) -> Iterator[Strip]:
    """Yield the strips of a capture.

    Args:
        sample: image and depth.
        rows: of a strip.
        height: of the capture.
        radius: of the PSFs: how far the image of a strip reaches beyond it, to be rendered with the border ``"valid"``.
        border: of the capture.
        reach: lowest and highest defocus, (2,).
        fields: of the pictures, behind a real lens.
    """
    sides = "replicate" if border == "zero" else border  # black has no depth of its own
    for top in range(0, height, rows):
        own = slice(top, min(top + rows, height))
        image = padded_band(sample.image, own, radius, border).to(sample.dtype)
        depth = padded_band(sample.depth, own, radius, sides).to(sample.dtype)
        before = 0 if border == "valid" else radius
        places = tuple(field.moved(top - before, -before) for field in fields)
        yield Strip(image, depth, "valid", own, reach, places)


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
