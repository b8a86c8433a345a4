"""Settings: fields of dataclasses with type, unit, range, default and purpose, each written once.

Commands make their options from them, and the page in the browser its controls. The purpose of a field is its entry in
the docstring's ``Args``; a sentence there that begins with ``None:`` names the replacement of a missing value. Modules
of settings import neither torch nor NumPy, so that ``--help`` is there at once.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from math import inf, isfinite
from types import NoneType, UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

MOST_PROCESSES = 1024  # more would exhaust a machine


@dataclass(frozen=True)
class Unit:
    """Unit and range of a number in settings, and its placeholder in ``--option VALUE``.

    Args:
        symbol: for its value; two words for a pair.
        name: of the unit, in words.
        least: smallest value.
        most: largest value.
        above: ``least`` itself is too small.
        infinite: infinity is allowed.

    Example:
        >>> Unit("M", "metres", 0, above=True).complaint(-1.0, float)
        'must be a number of metres above 0, got -1.0'
        >>> Unit("K", "", 0, 1024).complaint(5000, int)
        'must be a whole number from 0 to 1024, got 5000'
    """

    symbol: str
    name: str = ""
    least: float = -inf
    most: float = inf
    above: bool = False
    infinite: bool = False

    def complaint(self, value: Any, kind: type) -> str:
        """Return the fault of a number as the end of a sentence; an empty text if it is allowed."""
        if is_number(value, kind) and (self.infinite or -inf < value < inf) and self._holds(value):
            return ""
        return f"must be {self._allowed(kind)}, got {value!r:.80}"

    def _holds(self, value: float) -> bool:
        return (self.least < value if self.above else self.least <= value) and value <= self.most

    def _allowed(self, kind: type) -> str:
        words = "a whole number" if kind is int else "a number"
        words += f" of {self.name}" if self.name else ""
        if self.above:
            return f"{words} above {self.least:g}"
        if isfinite(self.most):
            return f"{words} from {self.least:g} to {self.most:.20g}"
        return f"{words} of at least {self.least:g}" if isfinite(self.least) else words


@dataclass(frozen=True)
class Choice(Unit):
    """One of some values.

    Args:
        choices: the values.
        words: their meanings, if names do not suffice.
        others: other values are checked elsewhere.
    """

    choices: tuple[Any, ...] = ()
    words: tuple[str, ...] = ()
    others: bool = False

    def complaint(self, value: Any, kind: type) -> str:
        """Return the fault of a value as the end of a sentence; an empty text if it is one of the choices."""
        known = value in self.choices or (self.others and isinstance(value, kind))
        return "" if known else f"must be one of {', '.join(map(repr, self.choices))}, got {value!r:.80}"


def one_of(choices: Iterable[Any], *, others: bool = False) -> Choice:
    """Return the unit of a setting with one of some values, or of the keys of their meanings.

    Example:
        >>> one_of(["edof", "depth"]).complaint("depht", str)
        "must be one of 'edof', 'depth', got 'depht'"
    """
    words = [text for text in choices.values() if isinstance(text, str)] if isinstance(choices, Mapping) else []
    return Choice("NAME", choices=tuple(choices), words=tuple(words), others=others)


Metres = Annotated[float, Unit("M", "metres", 0, above=True)]
Distance = Annotated[float, Unit("M", "metres", 0, above=True, infinite=True)]
DepthRange = Annotated[tuple[float, float], Unit("NEAR FAR", "metres", 0, above=True, infinite=True)]
Seconds = Annotated[float, Unit("S", "seconds", 0)]
Pixels = Annotated[int, Unit("PX", "pixels", 1)]
FNumber = Annotated[float, Unit("F", "", 0.5)]  # 0.5 at a numerical aperture of 1, the limit of a lens in air
Electrons = Annotated[float, Unit("E", "electrons", 0)]
Factor = Annotated[float, Unit("X")]
Count = Annotated[int, Unit("N", "", 1)]
CountOrNone = Annotated[int, Unit("N", "", 0)]
Processes = Annotated[int, Unit("N", "", 0, MOST_PROCESSES)]
Seed = Annotated[int, Unit("N", "", 0, 2**63 - 1)]


class Setting(NamedTuple):
    """A field of settings."""

    name: str
    kind: Any
    """Type without unit and without None; of a sequence that of its items."""
    items: int | None
    """Number of items of a sequence, 0 for any number; None for a single value."""
    unit: Unit
    default: Any
    """``dataclasses.MISSING`` if a value must be given."""
    optional: bool
    purpose: str
    unset: str
    """What takes the place of None, in words."""
    group: type
    """Class that has the field."""
    mark: Any
    """What else the type is annotated with."""


def settings_of(cls: Any) -> Iterator[Setting]:
    """Yield the fields of a dataclass of settings, those of its base classes first.

    Example:
        >>> @dataclass
        ... class Lens:
        ...     '''Lens.
        ...
        ...     Args:
        ...         focus: distance in focus. None: infinity.
        ...     '''
        ...     focus: Metres | None = None
        >>> (setting,) = settings_of(Lens)
        >>> setting.name, setting.kind, setting.unit.symbol, setting.purpose, setting.unset
        ('focus', <class 'float'>, 'M', 'distance in focus', 'infinity')
    """
    groups = [base for base in reversed(cls.__mro__) if is_dataclass(base)]
    for one in fields(cls):
        group = next(base for base in groups if one.name in base.__annotations__)
        texts = (documented(base)[2].get(one.name) for base in cls.__mro__ if is_dataclass(base))
        yield _setting(one, group, _hints(group)[one.name], *_purpose(next(filter(None, texts), "")))


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _setting(one: Any, group: type, hint: Any, purpose: str = "", unset: str = "") -> Setting:
    default = one.default if one.default_factory is MISSING else one.default_factory()
    unit, mark, optional = Unit(""), None, False
    while True:
        members = [member for member in get_args(hint) if member is not NoneType]
        if get_origin(hint) is Annotated:
            hint, found = get_args(hint)
            unit, mark = (found, mark) if isinstance(found, Unit) else (unit, found)
        elif get_origin(hint) in {Union, UnionType} and len(members) < len(get_args(hint)):
            hint, optional = Union[tuple(members)], True  # noqa: UP007 (of members that are found here)
        else:
            break
    items = None
    if get_origin(hint) is tuple:
        items = 0 if get_args(hint)[-1] is Ellipsis else len(get_args(hint))
        inner = _setting(one, group, get_args(hint)[0])
        hint, unit = inner.kind, inner.unit if inner.unit.symbol else unit
    return Setting(one.name, hint, items, unit, default, optional, purpose, unset, group, mark)


@cache
def documented(cls: type) -> tuple[str, str, dict[str, str]]:
    """Return the first sentence of a docstring, the text below it, and the entries of its ``Args``."""
    head, *sections = re.split(r"\n\n(?=(?:Args|Notes|Examples):\n)", inspect.cleandoc(cls.__doc__ or ""))
    rest = next((text.removeprefix("Args:\n") for text in sections if text.startswith("Args:\n")), "")
    summary, _, text = head.partition("\n\n")
    block = re.split(r"\n(?=\w[\w ]*:\n)", rest)[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n     +.*)*)", block, re.MULTILINE)
    return plain(summary), text, {name: plain(entry) for name, entry in entries}


def section(cls: type, title: str) -> str:
    """Return a section of a docstring without its indentation; an empty text if there is none.

    Example:
        >>> class Lens:
        ...     '''Lens.
        ...
        ...     Notes:
        ...         Plain glass.
        ...     '''
        >>> section(Lens, "Notes")
        'Plain glass.'
    """
    found = re.search(rf"^{title}:\n((?:    .*\n?|\n)+)", inspect.cleandoc(cls.__doc__ or ""), re.MULTILINE)
    return re.sub("^    ", "", found[1].rstrip(), flags=re.MULTILINE) if found else ""


def plain(text: str) -> str:
    """Return a text of a docstring in one line, without its markup.

    Example:
        >>> plain("as :class:`~kornia_tidy.TiDyOptics` takes it, such as ``'gather'``")
        "as TiDyOptics takes it, such as 'gather'"
    """
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text)
    return " ".join(re.sub(r"``([^`]*)``", r"\1", text).split())


def _purpose(entry: str) -> tuple[str, str]:
    """Split an entry of a docstring into its purpose and the replacement of None; mere references are left out."""
    text = re.sub(r"[,;]? \(?[Ss]ee [^.;]*\)?(?=[.;]|$)", "", entry)
    before, _, after = text.partition("None: ")
    unset, _, more = f"{after} ".partition(". ")
    return " ".join(f"{before} {more}".split()).removesuffix("."), unset.strip().removesuffix(".")


def check_settings(settings: Any) -> None:
    """Raise ``ValueError`` if a value is of another type than its field, beyond its range, or no choice."""
    for setting in settings_of(type(settings)):
        value = getattr(settings, setting.name)
        if value is None and setting.optional:
            continue
        if complaint := complaint_about(setting, value):
            raise ValueError(f"{setting.name} {complaint}")


def complaint_about(setting: Setting, value: Any) -> str:
    """Return the fault of a setting's value as the end of a sentence; an empty text if it is allowed."""
    if setting.items is not None:
        if not isinstance(value, (tuple, list)) or (setting.items and len(value) != setting.items):
            return f"must be {'two' if setting.items == 2 else setting.items or 'some'} values, got {value!r:.80}"
        return next(filter(None, (_complaint(setting, item) for item in value)), "")
    return _complaint(setting, value)


def _complaint(setting: Setting, value: Any) -> str:
    kind = setting.kind
    if kind in (int, float) or isinstance(setting.unit, Choice):
        return setting.unit.complaint(value, kind)
    words = {bool: "true or false", str: "a text"}.get(kind)
    return f"must be {words}, got {value!r:.80}" if words and not isinstance(value, kind) else ""


def is_number(value: Any, kind: type = float) -> bool:
    """Whether a value is a number that a float can hold; integers in JSON may be larger."""
    if isinstance(value, bool) or not isinstance(value, int if kind is int else (int, float)):
        return False
    return kind is int or isinstance(value, float) or abs(value) < 2**1023
