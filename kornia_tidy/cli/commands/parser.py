"""Options of a command from its settings: names, units, ranges, defaults and purposes are those of the dataclass.

A command is a dataclass of settings with a method ``run``. Its docstring may have the sections ``Notes`` and
``Examples``; options that are not among its ``basic`` names stand in ``--help-all`` only. A field that is a dataclass
itself is a group of options; a field ``Annotated[dict, Given(Settings)]`` holds those of the settings that were given,
by name. The field ``output`` is also ``-o``.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, is_dataclass
from functools import partial
from typing import Any, NoReturn, get_args

from kornia_tidy.settings import Choice, Setting, Unit, documented, section, settings_of

WIDEST = 40  # characters of choices that stand in braces behind an option


@dataclass(frozen=True)
class Given:
    """Mark of a field that holds the given values of some settings by name.

    Args:
        kind: class of the settings.
        only: which of its fields. None: all of them.
        but: and which not.
        stored: their defaults are those of a file.
    """

    kind: type
    only: tuple[str, ...] | None = None
    but: tuple[str, ...] = ()
    stored: bool = False

    def has(self, name: str) -> bool:
        """Whether a field of the settings is an option."""
        return (self.only is None or name in self.only) and name not in self.but


@dataclass(frozen=True)
class Argument(Unit):
    """Unit of a setting that is not an option: its value is recognised by its place."""


@dataclass(frozen=True)
class Parsed(Unit):
    """Unit of a value that a function reads from a word; it raises ``ValueError`` for unreadable words."""

    read: Callable[[str], Any] = str


@dataclass(frozen=True)
class Optional(Unit):
    """Unit of a value that may be left out behind its option: then it is the empty text."""


class Parser(argparse.ArgumentParser):
    """A parser that raises ``ValueError``, and keeps its help where nothing can be written."""

    def error(self, message: str) -> NoReturn:
        """Name the mistake in a sentence, and suggest a similar word."""
        message = re.sub(r"^argument (?:-\w/)?(\S+):", r"\1", message)
        if message.startswith("unrecognized arguments: "):
            word = message.split()[2].partition("=")[0]
            meant = difflib.get_close_matches(word, self._option_string_actions, 1)
            message = f"there is no {word}" + (f" (did you mean {meant[0]}?)" if meant else " here")
            if not word.startswith("-"):
                message = f"{word} must have the name of its option before it"
        raise ValueError(f"{message}; see {self.prog} --help")

    def _print_message(self, message: str, file: Any = None) -> None:
        if message:
            (file or sys.stderr).write(message)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Unchanged texts, and options with unbroken names."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)


def read(command: type, argv: Sequence[str], prog: str) -> Any:
    """Return a command with the settings that the arguments give.

    Raises:
        SystemExit: after ``--help``.
        ValueError: if an argument cannot be read, or a value is not allowed.
    """
    return _made(command, vars(make_parser(command, prog, "--help-all" in argv).parse_args(argv)))


def make_parser(command: type, prog: str, everything: bool = False) -> Parser:
    """Return the parser of a command, whose help shows everything, or the basic options in brief."""
    summary, text, _ = documented(command)
    notes, basic = section(command, "Notes"), getattr(command, "basic", None)
    brief = not everything and bool(notes or basic)
    examples = section(command, "Examples").split("\n\n")[: 2 if brief else None]
    parser = Parser(
        prog=prog,
        description="\n\n".join(filter(None, [summary, text, "" if brief else notes])),
        epilog="examples:\n" + textwrap.indent("\n\n".join(examples), "  ") if examples != [""] else None,
        formatter_class=partial(_Formatter, max_help_position=26),
        argument_default=argparse.SUPPRESS,
        add_help=False,
    )
    groups, usage = {"": parser.add_argument_group("options")}, []
    entries = list(_entries(command))
    names = {setting.name for setting, *_ in entries}
    for setting, group, given in entries:
        title, text, _ = ("", "", {}) if group is command else documented(group)
        hidden = brief and basic is not None and setting.name not in basic
        if not hidden and title not in groups:
            title_in_help = title[:1].lower() + title[1:].rstrip(".")
            groups[title] = parser.add_argument_group(title_in_help, text if text and not brief else None)
        help_text = argparse.SUPPRESS if hidden else _help(setting, brief, given, names)
        place = parser if hidden else groups[title]
        action = place.add_argument(*_words(setting), help=help_text, **_options(setting, given))
        if action.required:
            usage.append(" ".join([*action.option_strings[:1], _metavar(setting)]))
        elif action.nargs == "?" and not action.option_strings:
            usage.append(f"[{_metavar(setting)}]")
    parser.usage = " ".join(["%(prog)s", *usage, "[options]"])
    groups[""].add_argument("-h", "--help", action="help", help="show this help")
    if notes or basic:
        groups[""].add_argument("--help-all", action="help", help="show all options and notes")
    return parser


def _entries(kind: type, given: Given | None = None) -> Iterator[tuple[Setting, type, Given | None]]:
    """Yield the settings of a class and of its parts, each with the class that has it and the mark of its part."""
    for setting in settings_of(kind):
        if isinstance(setting.mark, Given):
            yield from _entries(setting.mark.kind, setting.mark)
        elif is_dataclass(setting.kind):
            yield from _entries(setting.kind)
        elif given is None or given.has(setting.name):
            yield setting, setting.group, given


def _words(setting: Setting) -> list[str]:
    if isinstance(setting.unit, Argument):
        return [setting.name]
    return [*(["-o"] if setting.name == "output" else []), f"--{setting.name.replace('_', '-')}"]


def _options(setting: Setting, given: Given | None) -> dict[str, Any]:
    """Return argparse's arguments of an option, without its help."""
    options: dict[str, Any] = {}
    if not isinstance(setting.unit, Argument):
        options |= {"dest": setting.name, "required": setting.default is MISSING and given is None}
    if setting.kind is bool:
        switch = setting.default is False and given is None
        return {**options, "action": "store_true" if switch else argparse.BooleanOptionalAction}
    options |= {"type": partial(_value, setting), "metavar": _metavar(setting)}
    if isinstance(setting.unit, Optional):
        return {**options, "nargs": "?", "const": ""}
    if setting.items:
        return {**options, "nargs": setting.items, "metavar": tuple((setting.unit.symbol.split() * 2)[: setting.items])}
    if setting.items is None:
        left_out = isinstance(setting.unit, Argument) and setting.default is not MISSING
        return {**options, "nargs": "?"} if left_out else options
    return {**options, "nargs": "+", **({} if isinstance(setting.unit, Argument) else {"action": "extend"})}


def _metavar(setting: Setting) -> str:
    choices = f"{{{','.join(map(str, _choices(setting)))}}}"
    return choices if 2 < len(choices) <= WIDEST else setting.unit.symbol or setting.name.upper()


def _choices(setting: Setting) -> tuple[Any, ...]:
    return setting.unit.choices if isinstance(setting.unit, Choice) else ()


def _help(setting: Setting, brief: bool, given: Given | None, names: Collection[str]) -> str:
    """Return purpose, unit and default of a setting; in brief its first sentence."""
    purpose = setting.purpose.partition(". ")[0] if brief else setting.purpose
    words = () if brief or not isinstance(setting.unit, Choice) else setting.unit.words
    if words:
        purpose += ": " + "; ".join(map(": ".join, zip(_choices(setting), words, strict=True)))
    elif _choices(setting) and not _metavar(setting).startswith("{"):
        purpose += f": {', '.join(_quoted(choice) for choice in _choices(setting))}"
    default = setting.unset if setting.default in (None, MISSING, ()) else _shown(setting.default, setting.unit)
    if given is not None and given.stored:
        default = "as stored"
    end = "; ".join([*filter(None, [setting.unit.name]), *([f"default: {default}"] if default else [])])
    text = purpose + (f" ({end})" if end else "")
    options = {name: f"--{name.replace('_', '-')}" for name in names if "_" in name}
    return re.sub(r"\b[a-z]+(?:_[a-z]+)+\b", lambda word: options.get(word[0], word[0]), text).replace("%", "%%")


def _quoted(choice: Any) -> str:
    return repr(choice) if isinstance(choice, str) and " " in choice else str(choice)


def _shown(value: Any, unit: Unit) -> str:
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, (tuple, list)):
        return ("x" if "x" in unit.symbol else " ").join(_shown(item, unit) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _value(setting: Setting, word: str) -> Any:
    """Return the value of an option from a word."""
    if setting.name == "output" and not word:
        raise argparse.ArgumentTypeError("must be a name, got an empty one")
    if isinstance(setting.unit, Parsed):
        try:
            return setting.unit.read(word)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
    if isinstance(setting.unit, Choice):
        named = {str(choice): choice for choice in setting.unit.choices}
        if word in named or setting.unit.others:
            return named.get(word, word)
        meant = difflib.get_close_matches(word, named, 1)
        hint = f" (did you mean {meant[0]}?)" if meant else ""
        raise argparse.ArgumentTypeError(setting.unit.complaint(word, str) + hint)
    kinds = get_args(setting.kind) or (setting.kind,)
    for kind in kinds:
        with suppress(ValueError):
            if kind is not str and (complaint := setting.unit.complaint(value := kind(word), kind)):
                raise argparse.ArgumentTypeError(complaint)
            return word if kind is str else value
    raise argparse.ArgumentTypeError(setting.unit.complaint(word, kinds[0]))


def _made(kind: type, given: dict[str, Any]) -> Any:
    """Return a settings object of the values that were given."""
    values: dict[str, Any] = {}
    for setting in settings_of(kind):
        if isinstance(setting.mark, Given):
            names = [each.name for each in settings_of(setting.mark.kind) if setting.mark.has(each.name)]
            values[setting.name] = {name: _plain(given[name]) for name in names if name in given}
        elif is_dataclass(setting.kind):
            values[setting.name] = _made(setting.kind, given)
        elif setting.name in given:
            values[setting.name] = _plain(given[setting.name])
    return kind(**values)


def _plain(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
