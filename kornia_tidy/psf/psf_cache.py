"""Which PSFs a scene needs, and a cache of them: while masks and camera do not change, each is computed once."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.psf.psf_bank import PSFBank

KINDS = 4  # banks remembered side by side: of RGB and of grey images, in float32 and in float64
_OF_EVERY_MODULE = frozenset(vars(nn.Module()))  # parameters and hooks among them, which are no plain attributes


@dataclass(eq=False)
class _Remembered:
    """PSFs of one kind of bank, by their defocus, for one setting of masks and camera."""

    setting: Sequence[object]
    states: Tensor
    weights: Tensor
    psfs: dict[float, Tensor] = field(default_factory=dict)
    last: tuple[Hashable, PSFBank] | None = None  # the bank asked for last, ready to be rendered through


class BankMemory:
    """Remembers PSFs by their defocus: of each kind of bank those for one setting of masks and camera at a time.

    The masks are compared by value, so a PSF that no longer holds is never given out, however they were changed.
    For use without gradients. Any number of threads may use it at once; those that meet on their first capture may each
    compute the same PSF.

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
        self._banks: dict[Hashable, _Remembered] = {}  # the one used last stands last

    def recall(
        self,
        kind: Hashable,
        setting: Sequence[object],
        states: Tensor,
        weights: Tensor,
        defocus: tuple[float, ...],
        build: Callable[[tuple[float, ...]], PSFBank],
        stray_light: tuple[str, int] | None = None,
    ) -> PSFBank:
        """Return the bank for these nodes; only PSFs that are not remembered are computed.

        Args:
            kind: of bank, such as its spectrum. Banks of another kind, data type or device are remembered beside it.
            setting: whatever else the PSFs depend on, compared by equality.
            states: phases shown, (S, N, N).
            weights: share of the exposure of each, (S,).
            defocus: nodes in radians.
            build: makes a bank of these states, before anything is done about stray light, for some nodes.
            stray_light: arguments of :meth:`PSFBank.with_stray_light`; the last bank is then kept whole and given out
                again, so its tensors must not be changed. Default: light outside the window is not treated.
        """
        with torch.inference_mode(False), torch.no_grad():  # remembered PSFs serve in training too
            kind = (kind, states.dtype, states.device)
            known = self._banks.get(kind)
            if (
                known is None
                or known.setting != setting
                or not (torch.equal(known.states, states) and torch.equal(known.weights, weights))
            ):
                known = _Remembered(setting, states.clone(), weights.clone())
            others = [(other, bank) for other, bank in self._banks.items() if other != kind]
            self._banks = {**dict(others[1 - KINDS :]), kind: known}
            if stray_light is not None and (last := known.last) is not None and last[0] == (defocus, stray_light):
                return last[1]
            missing = tuple(psi for psi in defocus if psi not in known.psfs)
            if missing:
                known.psfs.update(zip(missing, build(missing).psfs, strict=True))
            psfs = torch.stack([known.psfs[psi] for psi in defocus])
            bank = PSFBank(psfs, psfs.new_tensor(defocus), psfs.sum((2, 3)))
            if stray_light is not None:
                bank = bank.with_stray_light(*stray_light)
                known.last = (defocus, stray_light), bank
            return bank


def nodes_around(nodes: tuple[float, ...], defocus: Tensor) -> tuple[float, ...]:
    """Return the nodes that a defocus map lies between; all of them where it is empty or cannot be looked at."""
    if Mode.GRAPH in torch_mode() or not defocus.numel():
        return nodes
    lowest, highest = torch.stack(torch.aminmax(defocus.detach())).tolist()
    # On a node the next layer has no weight but a gradient: where depth is learnt it must be there.
    extra = int(defocus.requires_grad or Mode.TRANSFORM in torch_mode())
    first = max(0, bisect_right(nodes, lowest) - 1 - extra)
    last = min(len(nodes) - 1, max(0, bisect_left(nodes, highest) + extra))
    return nodes[min(first, last) : last + 1]


def present_intervals(nodes: tuple[float, ...], defocus: Tensor) -> list[bool]:
    """Return for each interval between nodes whether defocus lies in it; the outermost reach to infinity.

    Args:
        nodes: ascending.
        defocus: map in radians, or its lowest and highest value, (2,), between which everything counts.

    Example:
        >>> present_intervals((0.0, 1.0, 2.0, 3.0), torch.tensor([[-5.0, 2.5]]))
        [True, False, True]
        >>> present_intervals((0.0, 1.0, 2.0, 3.0), torch.tensor([-5.0, 2.5]))
        [True, True, True]
    """
    inner = torch.tensor(nodes[1:-1], dtype=torch.float64, device=defocus.device)
    interval = torch.bucketize(defocus.detach().double().contiguous(), inner, right=True).flatten()
    present = torch.bincount(interval, minlength=len(nodes) - 1) > 0
    if defocus.ndim == 1:
        present[int(interval.min()) : int(interval.max()) + 1] = True
    return present.tolist()


def plain_attributes(*parts: nn.Module) -> list[Any]:
    """Return the types and attributes of modules and submodules, but no parameters, buffers or hooks, to be compared.

    Example:
        >>> from kornia_tidy.modulator.modulator import DwellTimes
        >>> plain_attributes(DwellTimes((3, 1)))
        [<class 'kornia_tidy.modulator.modulator.DwellTimes'>, 'shares', (0.75, 0.25)]
    """
    found: list[Any] = []
    for part in parts:
        for module in part.modules():
            found.append(type(module))
            for name, value in vars(module).items():
                if name not in _OF_EVERY_MODULE:
                    # Containers are compared by their present values.
                    found += name, value.tolist() if hasattr(value, "tolist") else value
                    if isinstance(value, (list, dict, set)):
                        found[-1] = repr(value)
    return found
