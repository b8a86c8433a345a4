from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import pytest

from kornia_tidy.cli.commands.parser import Argument, Given, Optional, Parsed, make_parser, read
from kornia_tidy.settings import Count, Metres, Unit, one_of
from tests.base import BaseTester


def pair(text):
    first, _, second = text.partition("x")
    if not second:
        raise ValueError(f"must be AxB, got {text!r}")
    return int(first), int(second)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Lens.

    All in metres.

    Args:
        focal_length: of it. Longer enlarges.
        pitch: of pixels. None: by focal_length.
    """

    focal_length: Metres = 0.05
    pitch: Metres | None = None


@dataclass(frozen=True, kw_only=True)
class Run:
    """Run.

    Args:
        rate: 5 % are usual.
        sharp: ends.
    """

    rate: Metres = 1e-3
    sharp: bool = False
    other: int = 3


@dataclass(frozen=True, kw_only=True)
class Tool:
    """Do it.

    With care.

    Args:
        files: to read.
        output: to write.
        kind: of work.
        size: columns and rows.
        plot: draw it. None: not drawn.
        noise: a number or a file. None: 0.
        quick: at once.
        given: settings.
        lens: of it.

    Notes:
        Notes.

    Examples:
        one

        two

        three
    """

    files: Annotated[tuple[str, ...], Argument("FILES")]
    output: Annotated[str, Unit("OUT")]
    kind: Annotated[str, one_of(("slow one", "fast"))] = "fast"
    size: Annotated[tuple, Parsed("WxH", "pixels", read=pair)] = (4, 3)
    plot: Annotated[str, Optional("PNG")] | None = None
    noise: Annotated[float | str, Unit("S|FILE", "", 0)] | None = None
    weights: tuple[Count, ...] = ()
    quick: bool = False
    given: Annotated[dict[str, Any], Given(Run, but=("other",))] = field(default_factory=dict)
    lens: Lens = field(default_factory=Lens)

    basic: ClassVar = ("files", "output", "kind", "focal_length")

    def __post_init__(self) -> None:
        if self.quick and self.plot:
            raise ValueError("quick draws nothing")


class TestRead(BaseTester):
    def test_feature_defaults(self):
        assert read(Tool, ["a", "-o", "b"], "tool") == Tool(files=("a",), output="b")

    def test_feature_values(self):
        words = "a b -o out --kind fast --size 5x7 --plot --noise 0.5 --weights 1 2 --weights 3 --rate 2 --no-sharp"
        tool = read(Tool, [*words.split(), "--focal-length", "0.1"], "tool")
        assert tool == Tool(
            files=("a", "b"),
            output="out",
            size=(5, 7),
            plot="",
            noise=0.5,
            weights=(1, 2, 3),
            given={"rate": 2.0, "sharp": False},
            lens=Lens(focal_length=0.1),
        )
        assert read(Tool, ["a", "-o", "b", "--noise", "c.json", "--plot", "p"], "tool").noise == "c.json"

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["a"], "the following arguments are required: -o/--output"),
            (["-o", "b"], "the following arguments are required: FILES"),
            (
                ["a", "-o", "b", "--kind", "fst"],
                "--kind must be one of 'slow one', 'fast', got 'fst' (did you mean fast?)",
            ),
            (["a", "-o", "b", "--size", "5"], "--size must be AxB, got '5'"),
            (["a", "-o", "b", "--weights", "0"], "--weights must be a whole number of at least 1, got 0"),
            (["a", "-o", "b", "--weights", "1.5"], "--weights must be a whole number of at least 1, got '1.5'"),
            (["a", "-o", "b", "--noise", "-1"], "--noise must be a number of at least 0, got -1.0"),
            (["a", "-o", "b", "--noise", "nan"], "--noise must be a number of at least 0, got nan"),
            (["a", "-o", "b", "--pitch", "x"], "--pitch must be a number of metres above 0, got 'x'"),
            (["a", "-o", "b", "--othr", "1"], "there is no --othr (did you mean --"),
            (["a", "-o", "b", "--other", "1"], "there is no --other"),
            (["a", "-o", "b", "b.png"], "b.png must have the name of its option before it"),
        ],
    )
    def test_exception_names_the_option(self, words, sentence):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}.*; see tool --help$"):
            read(Tool, words, "tool")

    def test_exception_of_the_settings_together(self):
        with pytest.raises(ValueError, match=r"^quick draws nothing$"):
            read(Tool, ["a", "-o", "b", "--quick", "--plot", "c"], "tool")


class TestHelp(BaseTester):
    def test_feature_brief_and_whole(self, monkeypatch):
        monkeypatch.setenv("COLUMNS", "100")
        brief, whole = (make_parser(Tool, "tool", everything).format_help() for everything in (False, True))
        assert brief.startswith("usage: tool FILES -o OUT [options]\n\nDo it.\n\nWith care.\n")
        assert "--focal-length M        of it (metres; default: 0.05)\n" in brief
        assert "--size" not in brief
        assert "Notes." not in brief
        assert "three" not in brief
        assert "--help-all" in brief
        assert "  --focal-length M        of it. Longer enlarges (metres; default: 0.05)\n" in whole
        assert "  --pitch M               of pixels (metres; default: by --focal-length)\n" in whole
        assert "  --size WxH              columns and rows (pixels; default: 4x3)\n" in whole
        assert "  --kind NAME             " not in whole  # few names stand in braces
        assert "--kind {slow one,fast}" in whole
        assert "  --rate M                5 % are usual (metres; default: 0.001)\n" in whole
        assert "  --sharp, --no-sharp     ends\n" in whole
        assert "lens:\n  All in metres.\n" in whole
        assert "Notes." in whole
        assert "three" in whole
