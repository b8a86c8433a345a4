"""Optical glasses by the names that lens files have for them, from the catalogues of their makers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import files
from typing import Any

MAKERS = ("SCHOTT", "OHARA", "HOYA", "HIKARI", "CDGM", "SUMITA", "MISC")
"""Catalogues in the order in which a name without a maker is looked for; ``"MISC"`` has plastics and fused silica."""

_OTHER_NAMES = {"ACRYLIC": "PMMA", "BK7": "N-BK7", "F_SILICA": "SILICA", "FUSEDSILICA": "SILICA"}
_VARIANTS = ("HTULTRA", "HTI", "HT")  # sold with less absorption, of the same index


def catalogue_glass(name: str, makers: Sequence[str] = ()) -> dict[str, Any]:
    """Return the dispersion of a glass or plastic by its name, as prescriptions hold it.

    Args:
        name: such as ``"N-BK7"``, in any case; ``"NBK7_SCHOTT"`` as CODE V writes it.
        makers: catalogues that the file names, in their order. Where there are some, others are not looked into: one
            name means several glasses.

    Raises:
        ValueError: if the glass is unknown.

    Source: the makers' data sheets, as collected in the public domain (CC0) at refractiveindex.info; plastics:
        Sultanova, Kasarova and Nikolov, Acta Physica Polonica A 116, 585 (2009); silica: Malitson, J. Opt. Soc. Am. 55,
        1205 (1965).

    Example:
        >>> catalogue_glass("N-BK7")["sellmeier"][0]
        (1.03961212, 0.00600069867)
    """
    short = _OTHER_NAMES.get(name.upper(), name.upper())
    first, _, maker = short.partition("_")
    if maker in MAKERS:
        short = _OTHER_NAMES.get(first, first)
    wanted = [maker] if maker in MAKERS else [each.upper() for each in makers]
    known = [each for each in MAKERS if any(other.startswith(each) for other in wanted)] if wanted else MAKERS
    for each in (*sorted(known, key=lambda each: _place(each, wanted)), "MISC"):
        for variant in ("", *_VARIANTS):
            if found := _catalogue().get((each, _plain(short.removesuffix(variant)))):
                return found
    where = f" of {', '.join(wanted)}" if wanted else ""
    raise ValueError(
        f"the glass {name!r:.60}{where:.60} is not known: those of {', '.join(MAKERS[:-1])} are, some plastics, and "
        f"glasses by index and Abbe's number"
    )


def _place(maker: str, wanted: Sequence[str]) -> int:
    return next((i for i, other in enumerate(wanted) if other.startswith(maker)), MAKERS.index(maker))


def _plain(name: str) -> str:
    return name.replace("-", "").replace(" ", "")


@lru_cache(maxsize=1)
def _catalogue() -> dict[tuple[str, str], dict[str, Any]]:
    """Return each glass of the table: s for Sellmeier's formula, p for a power series of n^2."""
    table = {}
    for row in files("kornia_tidy.optics.lens").joinpath("glasses.csv").read_text("utf-8").splitlines()[1:]:
        maker, name, formula, *numbers = row.split(",")
        values = [float(number) for number in numbers]
        pairs = list(zip(values[::2], values[1::2], strict=True))
        table[maker, _plain(name)] = {"sellmeier" if formula == "s" else "powers": pairs}
    return table
