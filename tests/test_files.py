"""Reading and atomic writing of files: missing files, full disks and locked folders."""

from __future__ import annotations

import os
import resource
import signal
import threading

import pytest

from kornia_tidy.data import read_image
from kornia_tidy.files import (
    check_folder,
    csv_bytes,
    error_prefix,
    only_here,
    output_folder,
    parse_json,
    read_bytes,
    read_csv,
    read_json,
    write_bytes,
    write_folder,
)
from tests.base import BaseTester
from tests.forks import fork, wait


@pytest.fixture
def small_disk():
    """Simulate a full disk by a limit on the size of files, so that writing fails half-way."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 12, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


class TestReading(BaseTester):
    @pytest.mark.timeout(20)
    def test_exception_a_pipe_is_refused_and_not_waited_for(self, tmp_path):
        os.mkfifo(tmp_path / "pipe.png")
        with pytest.raises(ValueError, match=r"cannot read .*pipe\.png: it is not a regular file"):
            read_image(tmp_path / "pipe.png")

    @pytest.mark.timeout(20)
    @pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="there is no such file")
    def test_exception_a_device_is_refused_and_a_file_that_cannot_be_read_is_named(self):
        with pytest.raises(ValueError, match="cannot read /dev/zero: it is not a regular file"):
            read_bytes("/dev/zero")
        with pytest.raises(OSError, match=r"^cannot read /proc/self/mem: Input/output error$"):
            read_bytes("/proc/self/mem")

    def test_exception_a_name_that_no_file_can_have(self, tmp_path):
        with pytest.raises(ValueError, match=r"cannot read .{60,100}\.\.\.: the name is too long$"):
            read_bytes(tmp_path / ("a" * 5000))

    @pytest.mark.parametrize("levels", [101, 600, 100_000])
    def test_exception_json_nested_too_deep(self, levels, tmp_path):
        for text in ("[" * levels + "]" * levels, '{"a":' * levels + "1" + "}" * levels, '[{"a":' * levels):
            (tmp_path / "a.json").write_text(text)
            with pytest.raises(ValueError, match=r"cannot read .*a\.json: (its JSON is nested deeper|Expecting)"):
                read_json(tmp_path / "a.json")

    def test_feature_json_of_a_hundred_levels_is_read(self):
        assert repr(parse_json("[" * 100 + "]" * 100)) == "[" * 100 + "]" * 100

    @pytest.mark.parametrize(
        ("text", "sentence"),
        [
            (b"{", "Expecting"),
            (b'{"a": "\xff"}', "its JSON is not UTF-8: invalid start byte at byte 7"),
            (b"[1" + b"0" * 300 + b"]", "must have at most 300 digits, got 301"),
            (b"[-1" + b"0" * 5000 + b"]", "must have at most 300 digits, got 5002"),
            (b'{"a": 1, "b": {"c": 1, "c": 2}}', "its JSON names 'c' twice"),
            (b'{"a": "' + b" " * (1 << 23) + b'"}', r"its JSON must have at most 8388608 characters, got 8388617"),
        ],
    )
    def test_exception_json_that_is_none_or_may_do_harm(self, text, sentence):
        with pytest.raises(ValueError, match=sentence):
            parse_json(text)

    def test_exception_the_prefix_stands_once_and_names_the_kinds_that_are_told(self):
        twice, named = error_prefix("cannot read a.csv", KeyError), error_prefix("cannot read a.csv", KeyError)
        with pytest.raises(ValueError, match=r"^cannot read a\.csv: 'rgb'$"), twice, named:
            {}["rgb"]
        with pytest.raises(KeyError), error_prefix("cannot read a.csv"):
            {}["rgb"]

    def test_feature_a_table_comes_back_as_texts(self, tmp_path):
        write_bytes(tmp_path / "a.csv", csv_bytes([["name", "psnr"], ["a, b", 3.5], ['say "c"', ""]]))
        assert read_csv(tmp_path / "a.csv") == [{"name": "a, b", "psnr": "3.5"}, {"name": 'say "c"', "psnr": ""}]

    def test_exception_folders(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(FileNotFoundError, match=r"there is no folder .*file"):
            check_folder(tmp_path / "file")
        with pytest.raises(ValueError, match=r"cannot write into .*file: it is not a folder"):
            output_folder(tmp_path / "file")
        assert output_folder(tmp_path / "new") == tmp_path / "new"
        assert check_folder(str(tmp_path)) == tmp_path


class TestWriting(BaseTester):
    def test_exception_a_full_disk_names_the_file_and_leaves_nothing(self, small_disk, tmp_path):
        with pytest.raises(OSError, match=r"^cannot write .*out\.png: File too large$"):
            write_bytes(tmp_path / "out.png", bytes(1 << 14))
        with pytest.raises(OSError, match=r"^cannot write .*slm: File too large$"):
            write_folder(tmp_path / "slm", {"a": b"1", "b": bytes(1 << 14)})
        assert os.listdir(tmp_path) == []

    def test_exception_a_full_disk_leaves_what_was_there(self, small_disk, tmp_path):
        write_bytes(tmp_path / "out.png", b"before")
        with pytest.raises(OSError, match="cannot write"):
            write_bytes(tmp_path / "out.png", bytes(1 << 14))
        assert (tmp_path / "out.png").read_bytes() == b"before"
        assert os.listdir(tmp_path) == ["out.png"]

    def test_exception_a_folder_that_another_process_writes_meanwhile_is_its(self, tmp_path):
        class Slow(dict):
            def items(self):  # between the look for a folder and the renaming
                write_folder(tmp_path / "capture", {"a": b"first"})
                return super().items()

        with pytest.raises(FileExistsError, match=r"^cannot write .*capture: another process has written it"):
            write_folder(tmp_path / "capture", Slow(a=b"second"))
        assert os.listdir(tmp_path) == ["capture"]
        assert (tmp_path / "capture" / "a").read_bytes() == b"first"


class TestOnlyHere(BaseTester):
    def test_exception_the_second_is_refused_and_the_folder_given_back(self, tmp_path):
        with only_here(tmp_path, "a training is at work"):
            with (
                pytest.raises(ValueError, match=r"a training is at work in .* already: wait for it to end"),
                only_here(tmp_path, "a training is at work"),
            ):
                pass
            assert os.listdir(tmp_path) == []
        with only_here(tmp_path, "a training is at work"):
            pass

    def test_exception_another_thread_and_another_process(self, tmp_path):
        refused = []

        def work():
            try:
                with only_here(tmp_path, "it"):
                    pass
            except ValueError:
                refused.append(True)
            assert refused

        with only_here(tmp_path, "it"):
            thread = threading.Thread(target=work)
            thread.start()
            thread.join()
            assert refused
            refused.clear()
            assert wait(fork(work)) == 0

    def test_feature_a_killed_process_gives_it_back(self, tmp_path):
        def child():
            with only_here(tmp_path, "it"):
                os.kill(os.getpid(), signal.SIGKILL)

        assert wait(fork(child)) == -signal.SIGKILL
        with only_here(tmp_path, "it"):
            pass

    def test_feature_forks_that_live_on_do_not_hold_it(self, tmp_path):
        read, write = os.pipe()
        with only_here(tmp_path, "it"):
            process = fork(lambda: os.read(read, 1))
        with only_here(tmp_path, "it"):
            pass
        os.write(write, b"x")
        wait(process)
