"""Ctrl-C and SIGTERM in the middle of commands: exit status, nothing half written, and a state that goes on.

Nothing waits for a moment on the clock: a fork sends the signal to itself after a random time of its own on the
processor. SIGKILL is in tests/coded_datasets/test_resume.py and tests/training/test_resume.py.
"""

from __future__ import annotations

import argparse
import importlib
import os
import random
import shutil
import signal
import time
from pathlib import Path

import pytest
import torch

from kornia_tidy import cli
from kornia_tidy.files import replacing
from tests.base import BaseTester
from tests.coded_datasets.samples import contents
from tests.forks import fork, wait
from tests.hostile.limited import apart, command

RENDER = ("render", "--data", "dead-leaves", "--size", "48", "--scenes", "6", "--masks", "1", "--fidelity", "draft")
TRAIN = ("train", "--resume", "--data", "dead-leaves", "--size", "48", "--scenes", "6", "--validation-scenes", "2",
         "--epochs", "2", "--masks", "1", "--width", "4", "--batch", "2", "--save-every", "1")  # fmt: skip
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
WORD = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


@pytest.fixture(autouse=True)
def _one_thread():
    """Threads do not live on in a fork."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def send_after(number, seconds):
    """Let this process send itself a signal after so many seconds on the processor."""
    signal.signal(signal.SIGPROF, lambda *_: os.kill(os.getpid(), number))
    signal.setitimer(signal.ITIMER_PROF, seconds)


def run_instead(monkeypatch, action):
    """Let the command do something else."""
    parser = argparse.ArgumentParser()
    parser.set_defaults(run=action)
    monkeypatch.setattr(cli, "build_parser", lambda: parser)


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


def stopped_trainings(folder):
    """Disturb a training; return how often it was stopped. Its imports are none of what is disturbed."""
    importlib.import_module("kornia_tidy.training.run")
    return disturb(TRAIN, Path(folder), 20, seed=3)


class TestSignals(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("shards", [(), ("--shard-items", "2")])
    def test_feature_rendering_stopped_by_signals_ends_with_the_same_bytes(self, shards, tmp_path):
        assert disturb((*RENDER, *shards), tmp_path, 2, seed=1) > 0
        assert contents(tmp_path / "stopped" / "out") == contents(tmp_path / "whole" / "out")

    @pytest.mark.slow
    @pytest.mark.parametrize("shards", [(), ("--shard-items", "2")])
    def test_feature_rendering_stopped_at_twenty_moments(self, shards, tmp_path):
        assert disturb((*RENDER, *shards), tmp_path, 20, seed=2) > 0
        assert contents(tmp_path / "stopped" / "out") == contents(tmp_path / "whole" / "out")

    @pytest.mark.slow
    def test_feature_training_stopped_at_twenty_moments_ends_bit_for_bit_where_an_undisturbed_one_does(self, tmp_path):
        pytest.importorskip("lightning.pytorch")
        assert apart(stopped_trainings, str(tmp_path)) > 0
        one, other = ((tmp_path / name / "out" / "last.safetensors").read_bytes() for name in ("whole", "stopped"))
        assert one == other

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_feature_a_file_that_is_being_written_is_removed(self, number, tmp_path, monkeypatch):
        def write(_):
            with replacing(tmp_path / "out.png") as temporary:
                temporary.write_bytes(b"half")
                os.kill(os.getpid(), number)
                time.sleep(60)

        def command():
            signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
            os._exit(cli.main([]))

        run_instead(monkeypatch, write)
        assert wait(fork(command)) == STATUS[number]
        assert os.listdir(tmp_path) == []

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    @pytest.mark.parametrize("hidden", [False, True])
    def test_feature_a_signal_that_an_import_took_for_its_failure_is_told(self, hidden, number, monkeypatch, capsys):
        """As modules of C++ do, and our own sentence of a package that is missing."""

        def load(_):
            try:
                os.kill(os.getpid(), number)
                time.sleep(60)
            except KeyboardInterrupt as stop:
                raise ImportError("initialization failed") from (None if hidden else stop)

        run_instead(monkeypatch, load)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
        try:
            assert cli.main([]) == STATUS[number]
        finally:
            signal.signal(signal.SIGINT, before)
        assert capsys.readouterr().err == f"kornia-tidy: {WORD[number]}\n"

    def test_convention_a_handler_of_the_caller_stays(self, monkeypatch):
        run_instead(monkeypatch, bool)

        def mine(*_):
            """Stand for the handler of a program that calls the command."""

        before = signal.signal(signal.SIGTERM, mine)
        try:
            assert cli.main([]) == 0
            assert signal.getsignal(signal.SIGTERM) is mine
        finally:
            signal.signal(signal.SIGTERM, before)
        assert cli.main([]) == 0
        assert signal.getsignal(signal.SIGTERM) is before
