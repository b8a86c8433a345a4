"""PSFs that need not be computed again: while masks and camera stay as they are, each depth is computed once."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor

from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.runtime.threads import SharedLock

KINDS = 4  # banks remembered side by side: of RGB and of grey images, in float32 and in float64


class BankMemory:
    """Remembers PSFs by their defocus: of each kind of bank those for one setting of masks and camera at a time.

    The masks are compared by value, so a PSF that no longer holds is never given out, however they were changed.
    For use without gradients, by any number of threads: one computes a PSF, others that need it wait for it.

    Example:
        >>> asked = []
        >>> def build(nodes):
        ...     asked.append(nodes)
        ...     return PSFBank(torch.ones(len(nodes), 1, 1, 1), torch.tensor(nodes), torch.ones(len(nodes), 1))
        >>> memory, masks, weights = BankMemory(), torch.zeros(1, 4, 4), torch.ones(1)
        >>> for nodes in ((0.0, 1.0), (1.0, 2.0), (0.0, 2.0)):
        ...     bank = memory.recall("grey", (), masks, weights, nodes, build)
        >>> asked
        [(0.0, 1.0), (2.0,)]
    """

    def __init__(self) -> None:
        self._lock = SharedLock()
        self._banks: dict[Hashable, _Remembered] = {}  # the one used last stands last

    def recall(
        self,
        kind: Hashable,
        setting: tuple[object, ...],
        states: Tensor,
        weights: Tensor,
        defocus: Sequence[float],
        build: Callable[[tuple[float, ...]], PSFBank],
    ) -> PSFBank:
        """Return the bank for these nodes, building only what is not remembered.

        Args:
            kind: of bank, such as its spectrum. Banks of another kind, data type or device are remembered beside it.
            setting: whatever else the PSFs depend on, compared by equality.
            states: phases shown, (S, N, N), which no other thread changes meanwhile.
            weights: share of the exposure of each, (S,).
            defocus: nodes in radians.
            build: makes a bank of these states, before anything is done about stray light, for some nodes.
        """
        with torch.inference_mode(False), torch.no_grad():  # what is remembered must serve in training too
            with self._lock:
                kind = (kind, states.dtype, states.device)
                known = self._banks.pop(kind, None)
                if known is None or not known.holds_for(setting, states, weights):
                    known = _Remembered(setting, states, weights)
                    while len(self._banks) >= KINDS:
                        del self._banks[next(iter(self._banks))]
                self._banks[kind] = known
            psfs = known.psfs(tuple(defocus), build)  # other kinds need not wait for it
            return PSFBank(psfs, psfs.new_tensor(tuple(defocus)), psfs.sum((2, 3)))


class _Remembered:
    def __init__(self, setting: tuple[object, ...], states: Tensor, weights: Tensor) -> None:
        self._lock = SharedLock()
        self._setting, self._states, self._weights = setting, states.clone(), weights.clone()
        self._psfs: dict[float, Tensor] = {}

    def holds_for(self, setting: tuple[object, ...], states: Tensor, weights: Tensor) -> bool:
        same = self._setting == setting
        return same and torch.equal(self._states, states) and torch.equal(self._weights, weights)

    def psfs(self, defocus: tuple[float, ...], build: Callable[[tuple[float, ...]], PSFBank]) -> Tensor:
        with self._lock:
            missing = tuple(psi for psi in defocus if psi not in self._psfs)
            if missing:
                self._psfs.update(zip(missing, build(missing).psfs, strict=True))
            return torch.stack([self._psfs[psi] for psi in defocus])
