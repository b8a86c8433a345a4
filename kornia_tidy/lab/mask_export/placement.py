"""Placement of a mask on the panel of a modulator: the block of panel pixels that shows each mask pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_metres
from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.masks.base import MASK_SPAN
from kornia_tidy.optics.thin_lens import DIAMETERS, PITCHES

FLIPS = ("none", "left-right", "up-down")
ROTATIONS = (0, 90, 180, 270)
_SLACK = 1e-6  # panel pixels; tolerance for edges that lie on a pixel centre


@dataclass(frozen=True)
class PanelPlacement:
    r"""Placement of masks on a panel: each mask pixel becomes a block of whole panel pixels.

    A mask pixel is :math:`s = 2.3 R / (N p)` panel pixels wide, with R the pupil's radius on the panel, N the mask's
    shorter side and p the panel's pitch. A panel pixel shows the mask pixel that contains its centre. If s is a whole
    number, all blocks are equal; else their sides differ by one.

    Args:
        panel: rows and columns of the panel.
        panel_pitch: distance p between panel pixels in metres.
        pupil_radius: R in metres, on the panel. Default: the largest that fits with equal blocks.
        offset: position of the mask's centre relative to the panel's, in panel pixels to the right and down.
        flip: ``"none"``, ``"left-right"`` or ``"up-down"``; mirrors the mask before rotation.
        rotate: counter-clockwise rotation in degrees: 0, 90, 180 or 270.

    Raises:
        ValueError: if an argument is out of range.

    Convention:
        - Rows count downwards. Without flip and rotation, a phase that increases to larger columns of the panel moves
          the PSF to larger columns of the image. Use flip and rotate if the mirrors and lenses of a setup change this.
        - A panel pixel with its centre on the edge of two blocks belongs to the right or lower one. So if an odd
          number of panel pixels is left over, the mask lies half a pixel left of or above the centre.

    Example:
        >>> import torch
        >>> PanelPlacement((4, 7)).place(torch.tensor([[[1, 2], [3, 4]]]), background=0)[0]
        tensor([[0, 1, 1, 2, 2, 0, 0],
                [0, 1, 1, 2, 2, 0, 0],
                [0, 3, 3, 4, 4, 0, 0],
                [0, 3, 3, 4, 4, 0, 0]])
    """

    panel: tuple[int, int] = (1200, 1920)
    panel_pitch: float = 8e-6
    pupil_radius: float | None = None
    offset: tuple[int, int] = (0, 0)
    flip: str = "none"
    rotate: int = 0

    def __post_init__(self) -> None:
        if len(self.panel) != 2 or not all(isinstance(side, int) and side > 0 for side in self.panel):
            raise ValueError(f"panel must be (rows, columns), both positive whole numbers, got {self.panel}")
        check_pixels("the panel", *self.panel)
        check_metres("panel_pitch", self.panel_pitch, *PITCHES, "8 um is 8e-6")
        if self.pupil_radius is not None:
            check_metres("pupil_radius", self.pupil_radius, *DIAMETERS, "4 mm is 4e-3")
        if len(self.offset) != 2 or not all(isinstance(shift, int) for shift in self.offset):
            raise ValueError(f"offset must be whole panel pixels (right, down), got {self.offset}")
        check_choice("flip", self.flip, FLIPS)
        check_choice("rotate", self.rotate, ROTATIONS)

    def scale(self, size: tuple[int, int]) -> float:
        """Return the width of a mask pixel in panel pixels.

        Args:
            size: rows and columns of the mask.

        Raises:
            ValueError: if the mask is larger than the panel, or its pixels are smaller than the panel's.

        Example:
            >>> PanelPlacement().scale((23, 23))
            52.0
        """
        room = [side - 2 * abs(shift) for side, shift in zip(self.panel, reversed(self.offset), strict=True)]
        fitting = min(space / count for space, count in zip(room, self._rotated_size(size), strict=True))
        if self.pupil_radius is None:
            scale = float(math.floor(fitting))
        else:
            scale = MASK_SPAN * self.pupil_radius / (min(size) * self.panel_pitch)
            scale = float(round(scale)) if abs(scale - round(scale)) * max(size) < _SLACK else scale
        if scale < 1:
            raise ValueError(
                f"a mask of {size[0]}x{size[1]} pixels must have pixels at least as large as the panel's, got "
                f"{scale:.3g} of {self.panel[0]}x{self.panel[1]} panel pixels each"
            )
        if scale > fitting * (1 + 1e-9):
            largest = fitting * min(size) * self.panel_pitch / MASK_SPAN
            raise ValueError(
                f"the mask must fit on the panel, a pupil_radius of at most {largest * 1e3:.4g} mm at offset "
                f"{self.offset}, got {self.pupil_radius * 1e3:.4g} mm"  # ty: ignore[unsupported-operator]
            )
        return scale

    def radius(self, size: tuple[int, int]) -> float:
        """Return the pupil's radius on the panel in metres.

        Args:
            size: rows and columns of the mask.

        Raises:
            ValueError: as :meth:`scale`.

        Example:
            >>> round(PanelPlacement().radius((23, 23)), 6)
            0.00416
        """
        return self.scale(size) * min(size) * self.panel_pitch / MASK_SPAN

    def edges(self, size: tuple[int, int]) -> tuple[list[int], list[int]]:
        """Return the edges of the blocks: the first panel row of each, then the end of the last; the same for columns.

        Args:
            size: rows and columns of the mask before rotation.

        Example:
            >>> PanelPlacement((4, 7)).edges((2, 2))
            ([0, 2, 4], [1, 3, 5])
        """
        scale = self.scale(size)
        down, right = [
            [math.ceil((side - 1 + scale * (2 * i - count)) / 2 + shift - _SLACK) for i in range(count + 1)]
            for side, count, shift in zip(self.panel, self._rotated_size(size), reversed(self.offset), strict=True)
        ]
        return down, right

    def place(self, values: Tensor, background: int) -> Tensor:
        """Return frames of the panel's size that show the values of masks.

        Args:
            values: (K, rows, columns), one for each mask pixel.
            background: value of panel pixels outside the mask.

        Returns:
            (K, panel rows, panel columns), the type of ``values``.
        """
        down, right = self.edges((values.shape[1], values.shape[2]))
        frames = values.new_full((len(values), *self.panel), background)
        blocks = self._orient(values).repeat_interleave(torch.tensor(down).diff(), 1)
        blocks = blocks.repeat_interleave(torch.tensor(right).diff(), 2)
        frames[:, down[0] : down[-1], right[0] : right[-1]] = blocks
        return frames

    def read(self, frames: Tensor, size: tuple[int, int]) -> Tensor:
        """Return the mask values in frames made by :meth:`place`.

        Args:
            frames: (K, panel rows, panel columns).
            size: rows and columns of the mask.

        Returns:
            (K, rows, columns).

        Raises:
            ValueError: if the frames are not of the panel's size, or the pixels of a block differ.

        Example:
            >>> placement = PanelPlacement((20, 30), flip="left-right", rotate=90)
            >>> frames = placement.place(torch.tensor([[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]), 0)
            >>> placement.read(frames, (3, 3)).tolist()
            [[[1, 2, 3], [4, 5, 6], [7, 8, 9]]]
        """
        if tuple(frames.shape[1:]) != tuple(self.panel):
            raise ValueError(f"frames must have the panel's {self.panel} pixels, got {tuple(frames.shape[1:])}")
        down, right = self.edges(size)
        values = frames[:, down[:-1]][:, :, right[:-1]]
        blocks = values.repeat_interleave(torch.tensor(down).diff(), 1)
        blocks = blocks.repeat_interleave(torch.tensor(right).diff(), 2)
        if not torch.equal(blocks, frames[:, down[0] : down[-1], right[0] : right[-1]]):
            raise ValueError("each mask pixel must be a block of panel pixels of one grey level, found a mixed block")
        return self._orient_back(values)

    def _rotated_size(self, size: tuple[int, int]) -> tuple[int, int]:
        return (size[1], size[0]) if self.rotate % 180 else (size[0], size[1])

    def _orient(self, values: Tensor) -> Tensor:
        return torch.rot90(self._mirror(values), int(self.rotate) // 90, (-2, -1))

    def _orient_back(self, values: Tensor) -> Tensor:
        return self._mirror(torch.rot90(values, -int(self.rotate) // 90, (-2, -1)))

    def _mirror(self, values: Tensor) -> Tensor:
        return values if self.flip == "none" else values.flip(-1 if self.flip == "left-right" else -2)
