"""The PSF bank: how a point spreads at each defocus and in each colour, averaged over the masks of one exposure."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import torch
from safetensors.torch import save
from torch import Tensor

from kornia_tidy.checks import check_choice, check_finite, check_float_tensor, check_number, described
from kornia_tidy.files import error_prefix, write_bytes
from kornia_tidy.tensor_files import read_tensors

STRAY_LIGHT = ("renormalize", "veil", "discard")
MOST_LIGHT = 10.0  # of a PSF; a sum above is of counts, not of shares
TAILS = 1e-3  # of a PSF's light, see BankOfPSFs.with_tails


@dataclass(frozen=True, eq=False)
class BankOfPSFs:
    """What banks at one place and over the field share: PSFs (..., D, C, P, P), and values (..., D, C) of each."""

    axes: ClassVar[tuple[str, ...]]  # of the values of each PSF
    words: ClassVar[str]  # the name of their files in messages
    form: ClassVar[str]  # and how it names its format

    psfs: Tensor
    defocus: Tensor

    def __post_init__(self) -> None:
        for name in (part.name for part in fields(self)):
            value = getattr(self, name)
            if not isinstance(value, Tensor) and (value is not None or name != "veil"):
                raise TypeError(f"{name} must be a torch.Tensor, got {described(value)}: torch.as_tensor makes one")
        shape = tuple(self.psfs.shape)
        if len(shape) != len(self.axes) + 2 or shape[-2] != shape[-1] or shape[-1] % 2 == 0 or 0 in shape:
            raise ValueError(f"psfs must have shape ({', '.join(self.axes)}, P, P) with P odd, got {shape}")
        wanted = {"psfs": shape, "defocus": shape[-4:-3], "field": (shape[0], 2)}
        for part in fields(self):
            name, value = part.name, getattr(self, part.name)
            if value is not None and tuple(value.shape) != (own := wanted.get(name, shape[:-2])):
                raise ValueError(f"{name} must have shape {own} as psfs have, got {tuple(value.shape)}")

    def check(self) -> None:
        """Raise an error unless the values are light: real, finite, some of it, at nodes of defocus that ascend.

        PSFs of one place may not be negative either. Between measured places a thin plate may undershoot.

        Raises:
            TypeError: if a tensor is complex, of 8 bits or holds integers.
            ValueError: if a value is NaN or infinite, no PSF holds light or one far more than its point has, one or its
                energy is negative, energy is 0 where a PSF holds light, or nodes do not ascend.

        Example:
            >>> PSFBank(-torch.ones(1, 1, 1, 1), torch.zeros(1), torch.ones(1, 1)).check()
            Traceback (most recent call last):
            ValueError: psfs must not be negative, got -1.0
        """
        for name, value in self.present().items():
            if not value.is_floating_point():
                raise TypeError(f"{name} must be real floating-point numbers, got {value.dtype}")
            check_finite(name, value)
        if not bool((self.defocus.diff() > 0).all()):
            raise ValueError(f"defocus must ascend, got {self.defocus.tolist()!r:.200}")
        lowest, highest = (float(end) for end in torch.aminmax(self.psfs.detach()))
        if lowest < 0 and len(self.axes) == 2:
            raise ValueError(f"psfs must not be negative, got {lowest}")
        if not highest > 0:
            raise ValueError("psfs must hold some light, got none that is above 0")
        energy, lost = (getattr(self, name) for name in ("energy", "veil"))
        if bool(((energy < 0) | ((energy == 0) & (self.psfs.amax((-2, -1)) > 0))).any()):
            raise ValueError(f"energy must be positive where psfs hold light, got {float(energy.detach().min())}")
        light = float(self.psfs.detach().sum((-2, -1)).max())
        if light > MOST_LIGHT * max(1.0, float(energy.detach().max())):
            raise ValueError(
                f"psfs must be shares of the light of their points, got a sum of {light:.3g}: "
                f"PSFBank.from_measured scales them"
            )
        if lost is not None and not bool(((lost >= 0) & (lost <= 1)).all()):
            raise ValueError(f"veil must lie from 0 to 1, got {float(lost.min())} to {float(lost.max())}")

    def present(self) -> dict[str, Tensor]:
        """Return the tensors by their names."""
        return {part.name: value for part in fields(self) if (value := getattr(self, part.name)) is not None}

    @property
    def window(self) -> int:
        """Side P of the PSFs in pixels."""
        return self.psfs.shape[-1]

    def with_stray_light(self, kind: str, basis: int = 1) -> Self:
        """Return a bank in which the light outside the window is dealt with.

        Args:
            kind: ``"renormalize"`` scales each PSF to the light of its point, a sum of one on the axis; ``"veil"``
                keeps the PSFs and spreads the missing light over the image; ``"discard"`` loses it.
            basis: PSFs a channel, see :class:`~kornia_tidy.optics.spectrum.Spectrum`.
        """
        check_choice("stray_light", kind, STRAY_LIGHT)
        bank: Any = self
        if basis > 1:
            return self._with_stray_light_of_basis(bank.energy, kind, basis)
        if kind == "renormalize":
            tiny = torch.finfo(bank.energy.dtype).tiny  # a PSF without light stays without light
            return replace(self, psfs=self.psfs / bank.energy.clamp(min=tiny)[..., None, None], veil=None)
        lost = (1 - bank.energy).clamp(min=0) * getattr(self, "light", 1)
        return replace(self, veil=lost if kind == "veil" else None)

    def _with_stray_light_of_basis(self, energy: Tensor, kind: str, basis: int) -> Self:
        """Return the bank of a spectral scene with its stray light; white and uniform colours keep their values.

        A channel collects all light of its reflectance and no other. The window's share of the light differs between
        them, as between wavelengths; "renormalize" makes it up in the shape of the channel's PSF for white light.
        """
        seen = torch.eye(basis).to(energy)  # (C, B), as many channels as reflectances, at each point of a field
        seen = seen.repeat(energy.shape[1] // basis**2, 1)
        energy = energy.unflatten(1, (-1, basis))
        if kind != "renormalize":
            return replace(self, veil=(seen - energy).flatten(1) if kind == "veil" else None)
        white = energy.sum(2, keepdim=True).clamp(min=torch.finfo(energy.dtype).tiny)[..., None, None]
        psfs = self.psfs.unflatten(1, (-1, basis)) / white
        missing = seen[..., None, None] - energy[..., None, None] / white
        psfs = psfs + missing * psfs.sum(2, keepdim=True)
        return replace(self, psfs=psfs.flatten(1, 2), veil=None)

    def with_tails(self) -> Self:
        r"""Return a bank with PSFs that are zero nowhere: a thousandth of their light follows :math:`1 / (1 + r^2)`.

        Occlusion looks behind near things through the tails of the far layers' PSFs. Where those are cut to zero it
        finds nothing, and white would darken there: to a half behind the outline of a thing far out of focus before a
        sharp background, and to 0.998 or more with tails.

        Convention:
            - r is in pixels from the centre, and the tails end with the window. The energy stays.

        Example:
            >>> psfs = torch.zeros(1, 1, 5, 5)
            >>> psfs[..., 2, 2] = 1
            >>> tails = PSFBank(psfs, torch.zeros(1), torch.ones(1, 1)).with_tails().psfs[0, 0]
            >>> bool((tails > 0).all()), round(float(tails.sum()), 6), bool(tails[2, 2] > 0.999)
            (True, 1.0, True)
        """
        offset = torch.arange(self.window, device=self.psfs.device, dtype=self.psfs.dtype) - self.window // 2
        tails = 1 / (1 + offset[:, None] ** 2 + offset**2)
        light = self.psfs.sum((-2, -1), keepdim=True)
        return replace(self, psfs=(1 - TAILS) * self.psfs + TAILS * light * (tails / tails.sum()))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Return the bank on a device and in a data type; None: unchanged.

        Example:
            >>> bank = PSFBank(torch.ones(1, 1, 1, 1), torch.zeros(1), torch.ones(1, 1))
            >>> [bank.to("cpu", dtype).psfs.dtype for dtype in (None, torch.float64)]
            [torch.float32, torch.float64]
        """
        return type(self)(**{k: value.to(device, dtype or value.dtype) for k, value in self.present().items()})

    def at_defocus(self, defocus: Sequence[float]) -> Self:
        """Return the PSFs at other defocus, as a capture through linear layers has them.

        Between two nodes they are mixed linearly. Beyond the first and the last node they are those of that node.

        Args:
            defocus: nodes in radians, ascending.

        Example:
            >>> bank = PSFBank(torch.tensor([0.0, 1.0]).view(2, 1, 1, 1), torch.tensor([-1.0, 1.0]), torch.ones(2, 1))
            >>> bank.at_defocus([-3.0, 0.5, 1.0]).psfs.flatten()
            tensor([0.0000, 0.7500, 1.0000])
        """
        wanted = torch.tensor(checked_nodes(defocus), dtype=torch.float64, device=self.defocus.device)
        nodes, depths = self.defocus.double(), len(self.axes) - 2
        upper = torch.searchsorted(nodes, wanted).clamp(1, max(len(nodes) - 1, 1)).clamp(max=len(nodes) - 1)
        lower = (upper - 1).clamp(min=0)
        span = (nodes[upper] - nodes[lower]).clamp(min=torch.finfo(torch.float64).tiny)
        share = ((wanted - nodes[lower]) / span).clamp(0, 1)

        def mixed(values: Tensor) -> Tensor:
            below, above = (values.index_select(depths, own) for own in (lower, upper))
            return torch.lerp(below, above, share.to(values).view(-1, *[1] * (values.ndim - depths - 1)))

        kept = {k: mixed(value) for k, value in self.present().items() if k not in ("defocus", "field")}
        return replace(self, defocus=wanted.to(self.defocus), **kept)

    def with_channels(self, channels: int) -> Self:
        """Return the PSFs of one channel for three colours, or green of three for one channel.

        Args:
            channels: 1 or 3.

        Raises:
            ValueError: if they are of another number of channels, or another one is asked for.

        Example:
            >>> PSFBank.from_measured(torch.rand(2, 1, 5, 5), torch.arange(2.0)).with_channels(3).psfs.shape
            torch.Size([2, 3, 5, 5])
        """
        chosen = {(1, 3): [0, 0, 0], (3, 1): [1]}.get((own := self.psfs.shape[-3], channels), list(range(own)))
        if len(chosen) != channels:
            raise ValueError(f"PSFs of {channels} channels are needed, got {own}")
        held = {k: value for k, value in self.present().items() if k not in ("defocus", "field")}
        axis, kept = len(self.axes) - 1, torch.tensor(chosen, device=self.psfs.device)
        return replace(self, **{k: value.index_select(axis, kept) for k, value in held.items()})

    def save(
        self,
        path: str | os.PathLike[str],
        more: Mapping[str, Tensor] | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        """Write the bank as safetensors, all or nothing.

        Args:
            path: where to.
            more: further tensors for the file, under names with a dot in them.
            notes: its description in words.

        Raises:
            FileNotFoundError: if the folder does not exist.
        """
        tensors = {k: v.detach().cpu().contiguous() for k, v in {**self.present(), **(more or {})}.items()}
        write_bytes(path, save(tensors, metadata={**(notes or {}), "format": self.form}))

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str = "cpu") -> Self:
        """Read a bank written by :meth:`save`.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if the file is not such a bank, a value is NaN or infinite, the nodes do not ascend, or the PSFs
                of one place are negative somewhere.
        """
        stored, notes = read_tensors(path, cls.words, device)
        found, tensors = notes.get("format"), {name: value for name, value in stored.items() if "." not in name}
        names = {part.name for part in fields(cls)}
        if found != cls.form or not names - {"veil"} <= set(tensors) <= names:
            raise ValueError(f"{path} is not a {cls.words}: its format is {found!r:.40} with {sorted(tensors)!r:.200}")
        with error_prefix(f"cannot read {path}", TypeError):
            bank = cls(**tensors)
            bank.check()
        return bank


@dataclass(frozen=True, eq=False)
class PSFBank(BankOfPSFs):
    """Point spread functions over defocus and colour.

    Args:
        psfs: (D, C, P, P), the share of a point's light in each pixel; P is odd and the centre is the chief ray.
        defocus: (D,) ascending nodes in radians at the pupil edge at 530 nm.
        energy: (D, C) share of the light inside the window, before anything is done about the rest.
        veil: (D, C) share of the light that is spread evenly over the image, or None.

    Raises:
        ValueError: if the shapes do not fit each other. Values are checked by :meth:`check`, on use and in files.

    Example:
        >>> bank = PSFBank(torch.ones(2, 3, 1, 1), torch.tensor([-1.0, 1.0]), torch.ones(2, 3))
        >>> bank.window, bank.psfs.dtype
        (1, torch.float32)
    """

    axes = ("D", "C")
    words, form = "PSF bank", "kornia_tidy.psf_bank/1"

    energy: Tensor
    veil: Tensor | None = None

    @classmethod
    def from_measured(cls, psfs: Tensor, defocus: Tensor) -> PSFBank:
        """Return a bank from measured PSFs, each scaled to a sum of one and counted as holding all the light.

        Args:
            psfs: (D, C, P, P), not negative.
            defocus: (D,) radians, ascending.

        Raises:
            ValueError: if a value is negative or not finite, a PSF holds no light, or the nodes do not ascend.
        """
        check_float_tensor("psfs", psfs, 4, "(D, C, P, P)")
        total = psfs.sum((-2, -1))
        cls(psfs, defocus, total).check()
        if not bool((total > 0).all()):
            raise ValueError("every measured psf must hold some light, got one that is all zero")
        return cls(psfs / total[..., None, None], defocus, torch.ones_like(total))


def checked_nodes(defocus: Sequence[float]) -> tuple[float, ...]:
    """Return nodes of defocus as plain numbers, or raise unless they are one or more finite numbers.

    Example:
        >>> checked_nodes(torch.tensor([-1.0, 2.5]))
        (-1.0, 2.5)
    """
    given: Any = defocus
    listed = given.tolist() if hasattr(given, "tolist") else given
    if isinstance(listed, str) or not isinstance(listed, Iterable):
        raise TypeError(f"defocus must be a list of nodes in radians, such as [-10.0, 10.0], got {described(listed)}")
    nodes = list(listed)
    for psi in nodes:
        check_number("a node of defocus", psi, "radians")
    if not nodes or not all(math.isfinite(psi) for psi in nodes):
        raise ValueError(f"defocus must be one or more nodes in finite radians, got {nodes!r:.80}")
    return tuple(float(psi) for psi in nodes)


def enclosing_window(psfs: Tensor, share: float) -> int | None:
    """Return the smallest odd window, centred, that holds a share of the light in every PSF.

    Args:
        psfs: (..., P, P), each the share of a point's light in each pixel.
        share: between 0 and 1.

    Returns:
        Side in pixels, or None where even P does not hold it.

    Example:
        >>> psf = torch.zeros(5, 5)
        >>> psf[2, 2], psf[1, 2] = 0.7, 0.2
        >>> enclosing_window(psf, 0.5), enclosing_window(psf, 0.85), enclosing_window(psf, 0.95)
        (1, 3, None)
    """
    size = psfs.shape[-1]
    offset = (torch.arange(size, device=psfs.device) - size // 2).abs()
    ring = torch.maximum(offset[:, None], offset[None, :]).flatten()
    rings = psfs.new_zeros(*psfs.shape[:-2], size // 2 + 1).index_add(-1, ring, psfs.flatten(-2))
    held = rings.cumsum(-1).reshape(-1, size // 2 + 1).amin(0) >= share
    return 2 * int(held.long().argmax()) + 1 if bool(held.any()) else None
