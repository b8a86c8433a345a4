"""The PSFs of each state of an exposure, for renderers that are not linear in the PSF, such as occlusion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from kornia_tidy.psf.psf_bank import PSFBank


@dataclass(frozen=True, eq=False)
class StateBank:
    """PSFs over the states of one exposure, defocus and colour; iterating gives a :class:`PSFBank` for each state.

    Args:
        psfs: (S, D, C, P, P), the share of a point's light in each pixel.
        defocus: (D,) ascending nodes in radians at the pupil edge at 530 nm.
        energy: (S, D, C) share of the light inside the window, before anything is done about the rest.
        weights: (S,) share of the exposure of each state.
        veil: (S, D, C) share of the light that is spread evenly over the image, or None.

    Example:
        >>> banks = [PSFBank(torch.full((2, 3, 1, 1), x), torch.tensor([-1.0, 1.0]), torch.ones(2, 3)) for x in (0, 1)]
        >>> bank = StateBank.of(banks, torch.tensor([0.25, 0.75]))
        >>> bank.psfs.shape, [float(state.psfs[0, 0]) for state in bank]
        (torch.Size([2, 2, 3, 1, 1]), [0.0, 1.0])
    """

    psfs: Tensor
    defocus: Tensor
    energy: Tensor
    weights: Tensor
    veil: Tensor | None = None

    def __post_init__(self) -> None:
        if tuple(self.weights.shape) != tuple(self.psfs.shape[:1]):
            raise ValueError(
                f"weights must have shape ({len(self.psfs)},) as psfs have, got {tuple(self.weights.shape)}"
            )
        list(self)  # each state's bank checks its shapes

    @classmethod
    def of(cls, banks: Sequence[PSFBank], weights: Tensor) -> Self:
        """Return the bank of several states with PSFs at the same defocus."""
        veils = [bank.veil for bank in banks if bank.veil is not None]
        return cls(
            torch.stack([bank.psfs for bank in banks]),
            banks[0].defocus,
            torch.stack([bank.energy for bank in banks]),
            weights,
            torch.stack(veils) if veils else None,
        )

    def __len__(self) -> int:
        return len(self.psfs)

    def __iter__(self) -> Iterator[PSFBank]:
        for state in range(len(self)):
            veil = None if self.veil is None else self.veil[state]
            yield PSFBank(self.psfs[state], self.defocus, self.energy[state], veil)
