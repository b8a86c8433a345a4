"""Settings of the raw commands: headerless dumps, sizes and white balance."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from kornia_tidy.choices import WHITE_BALANCES
from kornia_tidy.cli.commands.parser import Argument, Parsed
from kornia_tidy.settings import Unit, one_of

if TYPE_CHECKING:
    from torch import Tensor

    from kornia_tidy.lab.raw.capture import RawCapture

RawFiles = Annotated[tuple[str, ...], Argument("FILES")]


def size(text: str) -> tuple[int, int]:
    """Return rows and columns of WIDTHxHEIGHT.

    Example:
        >>> size("768x512")
        (512, 768)
    """
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None:
        raise ValueError(f"must be WIDTHxHEIGHT in pixels, such as 768x512, got {text!r}")
    return int(match[2]), int(match[1])


Size = Annotated[tuple, Parsed("WxH", "pixels", read=size)]
Pattern = Annotated[str, Parsed("LETTERS", read=str.upper)]


@dataclass(frozen=True, kw_only=True)
class Dump:
    """Bare dumps of counts.

    A headerless file needs a description: give --size, --pattern, --black
    and --white, and all FILES are read as such dumps, row by row.

    Args:
        size: columns x rows, such as 768x512. None: as the raw file says.
        pattern: colours of the filter array's tile, by rows: RGGB, GMYC, 36 letters for X-Trans; NONE for monochrome.
            None: as the raw file says.
        black: count without light, one or one a place. None: as the raw file says.
        white: saturation count; for raw files, replaces that of the file. None: as the raw file says.
        dtype: of a count. None: uint16.
        byte_order: of a count. None: little.
    """

    size: Size | None = None
    pattern: Pattern | None = None
    black: tuple[Annotated[float, Unit("N", "counts")], ...] = ()
    white: Annotated[float, Unit("N", "counts")] | None = None
    dtype: Annotated[str, one_of(("uint8", "uint16"))] | None = None
    byte_order: Annotated[str, one_of(("little", "big"))] | None = None

    def open(self, path: str) -> RawCapture:
        """Open a raw file, or the dump that the options describe.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if it cannot be read, or the options do not describe a dump.
        """
        from kornia_tidy.lab.raw.capture import RawCapture

        if self.size is None:
            for name in ("pattern", "black", "dtype", "byte_order"):
                if getattr(self, name) not in (None, ()):
                    raise ValueError(f"--{name.replace('_', '-')} is for bare dumps of counts: give --size too")
            return RawCapture.open(path, white=self.white)
        for name in ("pattern", "black", "white"):
            if getattr(self, name) in (None, ()):
                raise ValueError(f"a bare dump of counts needs --{name}")
        assert self.white is not None
        return RawCapture.open_dump(
            path,
            self.size,
            None if self.pattern == "NONE" else self.pattern,
            self.black,
            self.white,
            self.dtype or "uint16",
            self.byte_order or "little",
        )


def white_balance(words: Sequence[str]) -> str | Tensor | None:
    """Return the white balance of ``--white-balance``: a name, factors, or None for the default.

    Example:
        >>> white_balance(["as-shot"]), white_balance(["2", "1", "1.5"])
        ('as shot', tensor([2.0000, 1.0000, 1.5000]))
    """
    import torch

    if not words:
        return None
    if len(words) == 1 and words[0].replace("-", " ") in WHITE_BALANCES:
        return words[0].replace("-", " ")
    try:
        return torch.tensor([float(word) for word in words])
    except ValueError:
        names = ", ".join(name.replace(" ", "-") for name in WHITE_BALANCES)
        raise ValueError(f"--white-balance is {names}, or factors, got {' '.join(words)}") from None


WhiteBalance = Annotated[tuple[str, ...], Unit("WB")]
