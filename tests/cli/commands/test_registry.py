"""All commands at once: what their help says, when it comes, and how they refuse values."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from collections import defaultdict
from dataclasses import MISSING

import pytest

from kornia_tidy.choices import PRETRAINED
from kornia_tidy.cli.command_line import COMMANDS, _class, main, read_command
from kornia_tidy.cli.commands.parser import Argument, _entries, make_parser
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.settings import section
from kornia_tidy.training.settings import NETWORK_RUN
from tests.base import BaseTester


def flat(commands=COMMANDS, words=()):
    """Yield all commands by their words."""
    for name, chosen in commands.items():
        if isinstance(chosen, str):
            yield (*words, name), _class(chosen)
        else:
            yield from flat(chosen, (*words, name))


ALL = dict(flat())
every_command = pytest.mark.parametrize("words", ALL, ids=" ".join)
# Words that mean something else for commands of other things.
OTHER_MEANINGS = {
    "bits", "black", "depth_weight", "electrons", "lens", "masks", "output", "reference", "scenes", "size",
}  # fmt: skip


def help_of(words, capsys, option="--help"):
    with pytest.raises(SystemExit) as leaving:
        main([*words, option])
    assert leaving.value.code == 0
    return capsys.readouterr().out


class TestRegistry(BaseTester):
    def test_feature_help_needs_neither_torch_nor_numpy(self):
        """In an interpreter of its own: importing them would take seconds."""
        code = (
            "import sys\n"
            "from kornia_tidy.cli.command_line import COMMANDS, _class, main\n"
            "from kornia_tidy.cli.commands.parser import make_parser\n"
            "stack = list(COMMANDS.values())\n"
            "while stack:\n"
            "    one = stack.pop()\n"
            "    if isinstance(one, dict):\n"
            "        stack += one.values()\n"
            "    else:\n"
            "        make_parser(_class(one), 'x').format_help()\n"
            "print(*sorted({'torch', 'numpy', 'kornia', 'matplotlib', 'cv2'} & set(sys.modules)))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert (done.stdout, done.stderr) == ("\n", "")

    @every_command
    def test_feature_help_says_purpose_unit_and_default_once(self, words):
        settings = {setting.name: setting for setting, *_ in _entries(ALL[words])}
        for action in make_parser(ALL[words], "kornia-tidy", everything=True)._actions:
            text = action.help or ""
            assert len(text) > 5, action.dest
            assert text.count("default:") <= 1, text
            assert not re.search(r"`|:\w+:|None", text), text
            setting = settings.get(action.dest)
            if setting is None or setting.kind is bool:
                continue
            assert setting.unit.symbol, f"{setting.name} has no unit"
            assert action.required or isinstance(setting.unit, Argument) or "default:" in text, action.dest

    @every_command
    def test_feature_help_is_short_and_help_all_has_everything(self, words, capsys, monkeypatch):
        monkeypatch.setenv("COLUMNS", "80")
        told = help_of(words, capsys)
        assert told.startswith(f"usage: kornia-tidy {' '.join(words)} ")
        assert len(told.splitlines()) <= 80
        if "--help-all" in told:
            told = help_of(words, capsys, "--help-all")
        for setting, *_ in _entries(ALL[words]):
            word = setting.unit.symbol if isinstance(setting.unit, Argument) else f"--{setting.name.replace('_', '-')}"
            assert word in told

    def test_feature_one_word_has_one_meaning(self):
        meanings = defaultdict(set)
        for command in ALL.values():
            for setting, *_ in _entries(command):
                meanings[setting.name].add((setting.unit.symbol, setting.unit.name, setting.kind, setting.items))
        assert {name for name, kinds in meanings.items() if len(kinds) > 1} == OTHER_MEANINGS
        assert [words for words, command in ALL.items() if getattr(command, "seed", 0)] == [("demo",)]

    @every_command
    def test_exception_a_value_that_is_none_is_refused_by_name(self, words, capsys):
        for setting, *_ in _entries(ALL[words]):
            option = f"--{setting.name.replace('_', '-')}"
            if setting.kind not in (int, float) or isinstance(setting.unit, Argument):
                continue
            wrong = "x" if setting.unit.most == float("inf") else f"{setting.unit.most + 1:.0f}"
            given = [*required(words, setting.name), option, *[wrong] * max(1, setting.items or 1)]
            assert main([*words, *given]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert line.startswith(f"kornia-tidy: error: {option} must be "), line
            assert line.endswith(f"; see kornia-tidy {' '.join(words)} --help")

    @every_command
    def test_feature_examples_are_read(self, words):
        text = re.sub(r"\\\n\s*", "", section(ALL[words], "Examples"))
        commands = [line for line in text.splitlines() if line.lstrip().startswith("kornia-tidy ")]
        for line in commands:
            argv = shlex.split(re.split(r"   | [>|] ", line.strip(), maxsplit=1)[0])
            assert isinstance(read_command(argv[1:]), ALL[words])
        assert commands or not text

    @every_command
    def test_feature_python_in_the_notes_finds_its_imports(self, words):
        text = section(ALL[words], "Notes")
        for line in re.findall(r"^ *(from kornia_tidy.* import .*)$", text, re.MULTILINE):
            exec(line, {})
        for module, name in re.findall(r"\b(kornia_tidy(?:\.[a-z]\w*)+)\.(\w+)", re.sub("from .* import .*", "", text)):
            assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


class TestNotes(BaseTester):
    """What notes say of other settings is what these say."""

    def test_feature_evaluate_names_every_system_that_comes_with_the_library(self):
        shipped, closed = section(ALL["evaluate",], "Notes").splitlines()
        assert shipped == f"Shipped systems: {', '.join(PRETRAINED)}."
        assert closed == f"Closed forms: {', '.join(CLOSED_FORMS)}."

    def test_feature_train_tells_the_defaults_of_a_network_behind_fixed_masks(self):
        told = section(ALL["train",], "Notes").partition("for a CPU:\n")[2].split()
        given = {name: value for name, value in NETWORK_RUN.items() if name != "learn" and value is not None}
        words = (
            (f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])) for name, value in given.items()
        )
        assert told == [word for pair in words for word in pair]


def required(words, but):
    """Return arguments that a command must be given, without one of them."""
    given = []
    for setting, _, part in _entries(ALL[words]):
        if setting.default is MISSING and part is None and setting.name != but:
            value = "1" if setting.kind in (int, float) else "x"
            given += [value] if isinstance(setting.unit, Argument) else [f"--{setting.name.replace('_', '-')}", value]
    return given


class TestMistakes(BaseTester):
    @pytest.mark.parametrize("command", ["demo", "systems", "trade"])
    def test_exception_without_matplotlib_comes_before_any_work(self, command, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        assert "pip install 'kornia-tidy[plot]'" in refused([command])
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("argv", "sentence"),
        [
            ([], "the following arguments are required: COMMAND; see kornia-tidy --help"),
            (["trainn"], "there is no command trainn (did you mean train?); see kornia-tidy --help"),
            (
                ["reconstruct"],
                "there is no command reconstruct (did you mean raw reconstruct?); see kornia-tidy --help",
            ),
            (["raw", "simulat"], "there is no command simulat (did you mean simulate?); see kornia-tidy raw --help"),
            (
                ["train", "--task", "depht"],
                "--task must be one of 'edof', 'depth', 'joint', got 'depht' (did you mean depth?); see kornia-tidy "
                "train --help",
            ),
            (["train", "--tsk", "depth"], "there is no --tsk (did you mean --task?); see kornia-tidy train --help"),
            (
                ["simulate", "a.png"],
                "the following arguments are required: --depth; see kornia-tidy simulate --help",
            ),
        ],
    )
    def test_exception_one_sentence_says_what_was_meant(self, argv, sentence, refused):
        assert refused(argv) == f"kornia-tidy: error: {sentence}"
