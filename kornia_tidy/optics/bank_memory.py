"""PSFs that need not be computed again: while masks and camera stay as they are, each depth is computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kornia_tidy.optics.psf_bank import PSFBank


class BankMemory:
    """Remembers PSFs by their defocus, for one setting of masks and camera at a time.

    The masks are compared by value, so a PSF that no longer holds is never given out, however they were changed.
    For use without gradients.

    Example:
        >>> asked = []
        >>> def build(nodes):
        ...     asked.append(nodes)
        ...     return PSFBank(torch.ones(len(nodes), 1, 1, 1), torch.tensor(nodes), torch.ones(len(nodes), 1))
        >>> memory, masks, weights = BankMemory(), torch.zeros(1, 4, 4), torch.ones(1)
        >>> for nodes in ((0.0, 1.0), (1.0, 2.0), (0.0, 2.0)):
        ...     bank = memory.recall((), masks, weights, nodes, build)
        >>> asked
        [(0.0, 1.0), (2.0,)]
    """

    def __init__(self) -> None:
        self._setting: tuple[object, ...] | None = None
        self._states = self._weights = torch.empty(0)
        self._psfs: dict[float, Tensor] = {}

    def recall(
        self,
        setting: tuple[object, ...],
        states: Tensor,
        weights: Tensor,
        defocus: Sequence[float],
        build: Callable[[tuple[float, ...]], PSFBank],
    ) -> PSFBank:
        """Return the bank for these nodes, building only what is not remembered.

        Args:
            setting: whatever else the PSFs depend on, compared by equality.
            states: phases shown, (S, N, N).
            weights: share of the exposure of each, (S,).
            defocus: nodes in radians.
            build: makes a bank, before anything is done about stray light, for some nodes.
        """
        with torch.inference_mode(False), torch.no_grad():  # what is remembered must serve in training too
            same = self._setting == setting and self._states.device == states.device
            if not (same and torch.equal(self._states, states) and torch.equal(self._weights, weights)):
                self._setting, self._states, self._weights = setting, states.clone(), weights.clone()
                self._psfs = {}
            missing = tuple(psi for psi in defocus if psi not in self._psfs)
            if missing:
                self._psfs.update(zip(missing, build(missing).psfs, strict=True))
            psfs = torch.stack([self._psfs[psi] for psi in defocus])
            return PSFBank(psfs, psfs.new_tensor(tuple(defocus)), psfs.sum((2, 3)))
