from __future__ import annotations

import io
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from kornia_tidy.cli import command_line
from kornia_tidy.cli.commands.simulate import Simulate
from tests.base import BaseTester
from tests.forks import fork, wait

FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
SHOW = ("masks", "show", "heights.npy")


class TestMain(BaseTester):
    @pytest.fixture
    def command_that(self, monkeypatch):
        """Make the command do something else than it should."""

        def install(action):
            monkeypatch.setattr(Simulate, "run", lambda _: action())
            return ["simulate", "image.png", "--depth", "depth.png"]

        return install

    def test_smoke_help_lists_the_commands(self, capsys):
        with pytest.raises(SystemExit) as exit_:
            command_line.main(["--help"])
        assert exit_.value.code == 0
        told = capsys.readouterr().out
        assert told.startswith("usage: kornia-tidy")
        assert all(f"    {name} " in told for name in command_line.COMMANDS)

    def test_smoke_version(self, capsys):
        with pytest.raises(SystemExit):
            command_line.main(["--version"])
        assert capsys.readouterr().out.startswith("kornia-tidy 0.")

    @pytest.mark.parametrize(
        "error",
        [
            ValueError("depth must be\n positive"),
            TypeError("depth must be positive"),
            KeyError("depth must be positive"),
            FileNotFoundError("depth must be positive"),
            PermissionError("depth must be positive"),
            ImportError("depth must be positive"),
        ],
        ids=lambda error: type(error).__name__,
    )
    def test_exception_becomes_one_sentence_and_status_2(self, error, command_that, capsys):
        def fail():
            raise error

        assert command_line.main(command_that(fail)) == 2
        captured = capsys.readouterr()
        assert captured.err == "kornia-tidy: error: depth must be positive\n"
        assert captured.out == ""

    def test_exception_of_a_programmer_is_one_sentence_and_status_70(self, command_that, capsys, monkeypatch):
        monkeypatch.delenv(command_line.DEBUG, raising=False)
        assert command_line.main(command_that(lambda: 1 / 0)) == 70
        (line,) = capsys.readouterr().err.splitlines()
        assert "a fault of kornia-tidy, not yours (ZeroDivisionError: division by zero); please report it" in line

    def test_exception_shows_where_it_came_from_if_asked(self, command_that, capsys, monkeypatch):
        monkeypatch.setenv(command_line.DEBUG, "1")
        assert command_line.main(command_that(lambda: 1 / 0)) == 70
        lines = capsys.readouterr().err.splitlines()
        assert lines[0].startswith("Traceback")
        assert lines[-1].startswith("kornia-tidy: error: this is a fault")

    @pytest.mark.parametrize(
        "action", [lambda: torch.empty(1 << 60), lambda: bytearray(1 << 62)], ids=["torch", "python"]
    )
    def test_exception_no_memory_is_one_sentence_and_status_2(self, action, command_that, capsys):
        assert command_line.main(command_that(action)) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("kornia-tidy: error: out of memory")

    def test_feature_a_reader_that_leaves_is_no_error(self, tmp_path, capfd):
        """As `kornia-tidy ... | head` does: nothing is said, and the status is that of SIGPIPE."""
        read, write = os.pipe()
        os.close(read)
        assert self.printing_to(write, tmp_path) == 141
        assert capfd.readouterr().err == ""

    @FULL
    @pytest.mark.parametrize("argv", [SHOW, ("--help",)], ids=["report", "help"])
    @pytest.mark.parametrize("unbuffered", [False, True])
    def test_exception_a_full_disk_under_the_output(self, argv, unbuffered, tmp_path, capfd):
        assert self.printing_to(os.open("/dev/full", os.O_WRONLY), tmp_path, argv, unbuffered) == 2
        assert capfd.readouterr().err == "kornia-tidy: error: [Errno 28] No space left on device\n"

    @staticmethod
    def printing_to(file, folder, argv=SHOW, unbuffered=False):
        """Return the exit status of a command that prints to a file of the system."""
        np.save(folder / "heights.npy", np.zeros((1, 3, 3)))
        status = folder / "status"

        def child():
            os.chdir(folder)
            sys.stdout = io.TextIOWrapper(os.fdopen(file, "wb", 0), write_through=unbuffered)
            status.write_text(str(command_line.main(argv)))

        assert wait(fork(child)) == 0
        os.close(file)
        return int(status.read_text())

    @pytest.mark.parametrize(
        "names", [("stdin",), ("stdout",), ("stderr",), ("stdin", "stdout", "stderr")], ids="+".join
    )
    def test_feature_closed_streams_lead_to_the_null_device(self, names, tmp_path):
        """As of some daemons: a file that is written must not get the number of a stream."""
        np.save(tmp_path / "heights.npy", np.zeros((1, 3, 3)))
        numbers = [("stdin", "stdout", "stderr").index(name) for name in names]

        def child():
            os.chdir(tmp_path)
            for name, number in zip(names, numbers, strict=True):
                os.close(number)
                setattr(sys, name, None)  # as Python does at its start
            assert command_line.main(SHOW) == 0
            assert command_line.main(["masks", "show", "missing.npy"]) == 2
            for number in numbers:
                assert os.path.samestat(os.fstat(number), os.stat(os.devnull))
                assert os.get_inheritable(number)

        assert wait(fork(child)) == 0

    @FULL
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize(
        ("streams", "status", "told"),
        [
            ("<&- >&- 2>&-", 0, ""),
            (">&-", 0, ""),
            (">/dev/full", 2, "kornia-tidy: error: [Errno 28] No space left on device\n"),
            (">/dev/full 2>/dev/full", 2, ""),
        ],
    )
    def test_feature_a_whole_process_without_streams(self, streams, status, told):
        """From its start to its end, where Python writes out what is left and may change the exit status."""
        command = ["sh", "-c", f'"$0" -m kornia_tidy info {streams}', sys.executable]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (status, told)

    def test_feature_interruption_returns_130(self, command_that, capsys):
        def interrupt():
            raise KeyboardInterrupt

        assert command_line.main(command_that(interrupt)) == 130
        assert capsys.readouterr().err == "kornia-tidy: interrupted\n"

    @pytest.mark.filterwarnings("always")
    def test_feature_a_warning_is_one_line(self, command_that, capsys):
        before = warnings.showwarning
        command_line.main(command_that(lambda: warnings.warn("3 of 9 pixels\nare clamped", stacklevel=1)))
        assert capsys.readouterr().err == "kornia-tidy: warning: 3 of 9 pixels are clamped\n"
        assert warnings.showwarning is before
