"""Which PSFs a scene needs, and the memory of them: for the same masks and lens, each depth is computed once."""

from __future__ import annotations

import pickle
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor, nn

from kornia_tidy.mode import Mode, torch_mode

_OF_EVERY_MODULE = frozenset(vars(nn.Module()))  # parameters and hooks among them, which are no plain attributes


@dataclass(frozen=True, eq=False)
class _Remembered:
    """Tensors of each depth, and the result made from the tensors of the last call."""

    depths: dict[float, tuple[Tensor, ...]] = field(default_factory=dict)
    asked: tuple[tuple[float, ...], Hashable] | None = None
    formed: Any = None
    nbytes: int = 0


class PSFMemory:
    """Tensors of each depth, such as PSFs, by all that they depend on: of those used last so many bytes.

    Keys are values, so tensors that no longer hold are never given out, however masks and lens were changed. Any number
    of threads may ask at once; those that meet on their first capture may each compute the same.

    Args:
        most_bytes: of all tensors and keys together. What is larger is computed anew each time.

    Example:
        >>> asked = []
        >>> def make(nodes):
        ...     asked.append(nodes)
        ...     return (torch.tensor(nodes),)
        >>> memory, masks = PSFMemory(), torch.zeros(1, 4, 4)
        >>> for nodes in ((0.0, 1.0), (1.0, 2.0), (0.0, 2.0)):
        ...     (psfs,) = memory.recall(values_of("grey", masks), nodes, make)
        >>> asked
        [(0.0, 1.0), (2.0,)]
    """

    def __init__(self, most_bytes: int = 256 << 20) -> None:
        self.most_bytes = most_bytes
        self._held: dict[Hashable, _Remembered] = {}  # the entry used last stands last

    def recall(
        self,
        key: tuple[Hashable, ...],
        defocus: tuple[float, ...],
        make: Callable[[tuple[float, ...]], tuple[Tensor, ...]],
        form: Callable[..., Any] | None = None,
        how: Hashable = None,
    ) -> Any:
        """Return tensors for these depths; only those of depths that are not remembered are computed.

        They may be given out again, so they must not be changed.

        Args:
            key: all that they depend on besides depth, see :func:`values_of`.
            defocus: depths in radians, ascending.
            make: computes the tensors of some depths, each with an axis of depths first.
            form: makes the result from the tensors. Default: a tuple of them.
            how: identifies the form, where the same tensors have several results.
        """
        with torch.inference_mode(False), torch.no_grad():  # remembered tensors serve in training too
            known = self._held.pop(key, None) or _Remembered()
            if known.asked != (defocus, how):
                depths, made = known.depths, ()
                if missing := tuple(sorted({*defocus} - {*depths})):
                    made = tuple(tensor.contiguous() for tensor in make(missing))
                    depths = depths | dict(zip(missing, zip(*(x.split(1) for x in made), strict=True), strict=True))
                # Sums are rounded in an order that follows the layout: it is the same whatever is remembered.
                whole = missing == defocus
                found = made if whole else tuple(map(torch.cat, zip(*(depths[psi] for psi in defocus), strict=True)))
                # The result of `form` takes as much memory again.
                nbytes = ((not whole) + (form is not None)) * sum(x.nbytes for x in found)
                nbytes += sum(len(value) for value in key if isinstance(value, bytes))  # of masks
                if nbytes + sum(x.nbytes for own in depths.values() for x in own) > self.most_bytes:  # all but these go
                    depths = dict(zip(defocus, zip(*(x.split(1) for x in found), strict=True), strict=True))
                nbytes += sum(x.nbytes for own in depths.values() for x in own)
                known = _Remembered(depths, (defocus, how), form(*found) if form else found, nbytes)
            if known.nbytes <= self.most_bytes:
                self._held[key] = known
                held = sum(own.nbytes for own in list(self._held.values()))
                for oldest in list(self._held):  # other threads do the same: after the last of them all is in order
                    if held > self.most_bytes and oldest is not key:
                        held -= self._held.pop(oldest, _Remembered()).nbytes
            return known.formed


MEMORY = PSFMemory()
"""The memory of all cameras of the process."""


def values_of(*parts: object) -> tuple[Hashable, ...]:
    """Return a key for tensors and modules: the values of tensors; the identity and plain attributes of modules.

    Example:
        >>> from kornia_tidy.modulator.modulator import DwellTimes
        >>> values_of(DwellTimes((3, 1)))[1:]
        (<class 'kornia_tidy.modulator.modulator.DwellTimes'>, 'shares', (0.75, 0.25))
        >>> values_of(torch.zeros(2)) == values_of(torch.zeros(2)) != values_of(torch.ones(2))
        True
    """
    found: list[Hashable] = []
    for part in parts:
        if isinstance(part, Tensor):
            bits = part.detach().cpu().flatten().view(torch.uint8)  # NumPy does not have all data types
            found += part.dtype, part.device, tuple(part.shape), bits.numpy().tobytes()
        elif isinstance(part, nn.Module):
            found.append(weakref.ref(part))
            for module in part.modules():
                found.append(type(module))
                for name, value in vars(module).items():
                    if name not in _OF_EVERY_MODULE:
                        plain = value.tolist() if hasattr(value, "tolist") else value
                        try:
                            hash(plain)
                        except TypeError:  # a list, or a user's own class
                            plain = _hashable(plain)
                        found += name, plain
        else:
            found.append(cast("Hashable", part))
    return tuple(found)


def _hashable(value: object) -> Hashable:
    """Return a key in the place of a value that has no hash."""
    try:
        return pickle.dumps(value)
    except (pickle.PicklingError, AttributeError, TypeError):  # such as a lambda
        return repr(value)


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
