"""Ctrl-C and SIGTERM in the middle of commands: exit status, nothing half written, and a state that goes on.

Nothing waits for a moment on the clock: a fork sends the signal to itself after a random time of its own on the
processor. SIGKILL is in tests/training/coded_datasets/test_resume.py and tests/training/test_resume.py.
"""

from __future__ import annotations

import importlib
import os
import random
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from kornia_tidy.cli import command_line
from kornia_tidy.files import replacing
from kornia_tidy.signals import is_command
from tests.base import BaseTester
from tests.forks import fork, wait
from tests.hostile.limited import command
from tests.training.coded_datasets.samples import contents

pytestmark = pytest.mark.usefixtures("one_thread")
RENDER = ("render", "--data", "dead-leaves", "--size", "48", "--scenes", "6", "--masks", "1", "--fidelity", "draft")
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
WORD = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def send_after(number, seconds):
    """Let this process send itself a signal after so many seconds on the processor."""
    signal.signal(signal.SIGPROF, lambda *_: os.kill(os.getpid(), number))
    signal.setitimer(signal.ITIMER_PROF, seconds)


def run_instead(monkeypatch, action):
    """Let the command do something else."""
    monkeypatch.setattr(command_line, "read_command", lambda _: SimpleNamespace(run=lambda: action(None)))


def whole_run(argv, folder):
    """Run a command undisturbed; return the seconds on the processor that it took."""
    before = os.times()
    outcome = command(argv, folder)
    assert outcome.status == 0, outcome
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def disturb(argv, folder, moments, seed):
    """Send signals at random moments of a command, each time going on, and end it; return how often it was stopped."""
    (folder / "whole").mkdir()
    (folder / "stopped").mkdir()
    seconds = whole_run([*argv, "-o", "out"], folder / "whole")
    generator, stopped = random.Random(seed), 0
    for moment in range(moments):
        number = (signal.SIGTERM, signal.SIGINT)[moment % 2]
        after = generator.uniform(0.05, 0.9) * seconds
        outcome = command([*argv, "-o", "out"], folder / "stopped", lambda n=number, s=after: send_after(n, s))
        assert outcome.status in (0, STATUS[number]), outcome
        assert "Traceback" not in outcome.told
        assert outcome.status == 0 or outcome.told.endswith(f"kornia-tidy: {WORD[number]}\n"), outcome
        stopped += outcome.status != 0
        left = [path for path in (folder / "stopped").rglob("*") if path.suffix == ".tmp"]
        assert not left, left
        if outcome.status == 0:
            shutil.rmtree(folder / "stopped" / "out")
    assert command([*argv, "-o", "out"], folder / "stopped").status == 0
    return stopped


class TestSignals(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("shards", [(), ("--shard-items", "2")])
    def test_feature_rendering_stopped_by_signals_ends_with_the_same_bytes(self, shards, tmp_path):
        assert disturb((*RENDER, *shards), tmp_path, 2, seed=1) > 0
        assert contents(tmp_path / "stopped" / "out") == contents(tmp_path / "whole" / "out")

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_feature_a_file_that_is_being_written_is_removed(self, number, tmp_path, monkeypatch):
        def write(_):
            with replacing(tmp_path / "out.png") as temporary:
                temporary.write_bytes(b"half")
                os.kill(os.getpid(), number)
                time.sleep(60)

        def command():
            signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
            os._exit(command_line.main([]))

        run_instead(monkeypatch, write)
        assert wait(fork(command)) == STATUS[number]
        assert os.listdir(tmp_path) == []

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    @pytest.mark.parametrize("taken", ["pass", "raise ImportError('initialization failed') from None"])
    def test_feature_a_signal_in_an_import_that_would_take_it_waits_for_its_end(
        self, taken, number, monkeypatch, capsys, tmp_path
    ):
        """Some modules go on after any exception, others tell it as their own failure, as those of C++ do."""
        told = (
            f"import os, time\ntry:\n os.kill(os.getpid(), {number:d})\n time.sleep(0.1)\nexcept BaseException: {taken}"
        )
        (tmp_path / "takes_all.py").write_text(told)
        monkeypatch.syspath_prepend(tmp_path)

        def load(_):
            importlib.import_module("takes_all")
            time.sleep(10)

        run_instead(monkeypatch, load)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
        try:
            assert command_line.main([]) == STATUS[number]
        finally:
            signal.signal(signal.SIGINT, before)
            sys.modules.pop("takes_all", None)
        assert capsys.readouterr().err == f"kornia-tidy: {WORD[number]}\n"

    def test_convention_a_handler_of_the_caller_stays(self, monkeypatch):
        run_instead(monkeypatch, bool)

        def mine(*_):
            """Stand for the handler of a program that calls the command."""

        before = signal.signal(signal.SIGTERM, mine)
        try:
            assert command_line.main([]) == 0
            assert signal.getsignal(signal.SIGTERM) is mine
        finally:
            signal.signal(signal.SIGTERM, before)
        assert command_line.main([]) == 0
        assert signal.getsignal(signal.SIGTERM) is before


class TestStart(BaseTester):
    """Signals while the command imports what it needs, in a process of its own with a torch that sends them."""

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    @pytest.mark.parametrize("started", ["script", "module"])
    def test_feature_a_signal_during_the_imports_ends_the_command_with_a_word(self, started, number, tmp_path):
        """Even where the import would take any exception for its own failure."""
        assert self.started(started, tmp_path, number, ignored=False) == (
            STATUS[number],
            f"kornia-tidy: {WORD[number]}\n",
        )

    def test_convention_an_interruption_that_is_ignored_stays_so(self, tmp_path):
        """As of jobs in the background of a shell."""
        assert self.started("module", tmp_path, signal.SIGINT, ignored=True) == (7, "")

    def test_convention_a_program_that_imports_us_handles_its_own_signals(self, tmp_path):
        (tmp_path / "mine.py").write_text("import kornia_tidy.optics")
        self.write_torch(tmp_path, signal.SIGINT)
        assert self.run(["mine.py"], tmp_path)[0] == 8

    @pytest.mark.parametrize(
        ("name", "original", "expected"),
        [
            ("/usr/bin/kornia-tidy", ["python", "/usr/bin/kornia-tidy", "info"], True),
            ("C:/Scripts/kornia-tidy.exe", ["python", "C:/Scripts/kornia-tidy.exe"], True),
            ("-m", ["python", "-m", "kornia_tidy", "info"], True),
            ("-m", ["python", "-mkornia_tidy"], True),
            ("-m", ["python", "-m", "mine", "kornia-tidy"], False),
            ("-c", ["python", "-c", "import kornia_tidy"], False),
            ("", ["python"], False),
            ("kornia_tidy_plots.py", ["python", "kornia_tidy_plots.py"], False),
            ("/usr/bin/kornia-tidy", ["python", "-c", "spawn_main()", "--multiprocessing-fork"], False),
        ],
    )
    def test_convention_which_processes_are_the_command(self, name, original, expected, monkeypatch):
        monkeypatch.setattr(sys, "argv", [name])
        monkeypatch.setattr(sys, "orig_argv", original)
        assert is_command() == expected

    def started(self, how, folder, number, *, ignored):
        """Return exit status and standard error of the command, whose import of torch sends a signal."""
        self.write_torch(folder, number)
        (folder / "kornia-tidy").write_text("import sys\nfrom kornia_tidy.cli import main\nsys.exit(main())\n")
        arguments = ["kornia-tidy"] if how == "script" else ["-m", "kornia_tidy"]
        return self.run([*arguments, "info"], folder, ignored=ignored)

    @staticmethod
    def write_torch(folder, number):
        text = f"""
            import os, time
            try:
                os.kill(os.getpid(), {number:d})
                time.sleep(0.1)
            except BaseException:
                os._exit(8)
            os._exit(7)
        """
        (folder / "torch.py").write_text(textwrap.dedent(text))

    @staticmethod
    def run(arguments, folder, *, ignored=False):
        def handle():
            signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.SIG_DFL)

        root = Path(__file__).resolve().parents[2]
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{root}"},
            preexec_fn=handle,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stderr
