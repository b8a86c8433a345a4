from __future__ import annotations

import warnings

import pytest

from kornia_tidy import cli
from tests.base import BaseTester


class TestMain(BaseTester):
    @pytest.fixture
    def command_that(self, monkeypatch):
        """Make the command do something else than it should."""

        def install(action):
            monkeypatch.setattr(cli.simulate, "run", lambda args: action())
            return ["simulate", "image.png", "--depth", "depth.png"]

        return install

    @pytest.mark.parametrize(
        "argv",
        [[], ["simulate"], ["demo"], ["systems"], ["trade"], ["train"], ["evaluate"], ["raw"], ["render"], ["info"]],
    )
    def test_smoke_help_teaches_and_exits_with_zero(self, argv, capsys):
        with pytest.raises(SystemExit) as exit_:
            cli.main([*argv, "--help"])
        assert exit_.value.code == 0
        assert "usage: kornia-tidy" in capsys.readouterr().out

    def test_smoke_version(self, capsys):
        with pytest.raises(SystemExit):
            cli.main(["--version"])
        assert capsys.readouterr().out.startswith("kornia-tidy 0.")

    def test_feature_all_well_returns_zero(self, command_that):
        assert cli.main(command_that(lambda: None)) == 0

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

        assert cli.main(command_that(fail)) == 2
        captured = capsys.readouterr()
        assert captured.err == "kornia-tidy: error: depth must be positive\n"
        assert captured.out == ""

    def test_exception_of_a_programmer_is_not_hidden(self, command_that):
        with pytest.raises(ZeroDivisionError):
            cli.main(command_that(lambda: 1 / 0))

    def test_feature_interruption_returns_130(self, command_that, capsys):
        def interrupt():
            raise KeyboardInterrupt

        assert cli.main(command_that(interrupt)) == 130
        assert capsys.readouterr().err == "kornia-tidy: interrupted\n"

    @pytest.mark.filterwarnings("always")
    def test_feature_a_warning_is_one_line(self, command_that, capsys):
        before = warnings.showwarning
        cli.main(command_that(lambda: warnings.warn("3 of 9 pixels\nare clamped", stacklevel=1)))
        assert capsys.readouterr().err == "kornia-tidy: warning: 3 of 9 pixels are clamped\n"
        assert warnings.showwarning is before
