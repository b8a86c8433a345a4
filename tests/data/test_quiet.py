from __future__ import annotations

import os
import threading

import cv2
import numpy as np
import pytest

from kornia_tidy.data.quiet import caught
from kornia_tidy.data.stored import decode_stored
from tests.base import BaseTester
from tests.forks import fork, wait


class TestCaught(BaseTester):
    def test_feature_lines_of_libraries_are_caught_and_others_printed(self, capfd):
        with caught() as said:
            os.write(2, b"libpng warning: odd\na thread's own words\nCorrupt JPEG data: bad Huffman code\n")
        assert said == ["libpng warning: odd", "Corrupt JPEG data: bad Huffman code"]
        assert capfd.readouterr().err == "a thread's own words\n"

    def test_feature_more_than_a_pipe_holds_does_not_hang(self, capfd):
        with caught() as said:
            for _ in range(10_000):
                try:
                    os.write(2, b"libpng warning: and again, and again\n")
                except BlockingIOError:
                    break
        assert len(said) > 100
        assert capfd.readouterr().err == ""

    def test_exception_stderr_comes_back(self, capfd):
        with pytest.raises(ZeroDivisionError), caught():
            raise ZeroDivisionError
        os.write(2, b"after\n")
        assert capfd.readouterr().err == "after\n"

    def test_feature_a_fork_meanwhile_has_its_stderr_and_may_catch(self, capfd):
        def child():
            os.write(2, b"from the child\n")
            with caught() as said:
                os.write(2, b"libpng warning: in the child\n")
            assert said

        with caught() as said:
            assert wait(fork(child)) == 0
        assert said == []
        assert capfd.readouterr().err == "from the child\n"

    def test_feature_threads_decode_each_their_own(self, capfd):
        whole = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8))[1].tobytes()
        bad = whole[: len(whole) // 2] + b"\xff\xd9"
        outcomes = []

        def work(number):
            for _ in range(30):
                try:
                    outcomes.append(
                        (number % 2, decode_stored(bad if number % 2 else whole, "a").values.shape == (40, 60, 1))
                    )
                except ValueError:
                    outcomes.append((number % 2, "refused"))

        threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert set(outcomes) == {(0, True), (1, "refused")}
        assert capfd.readouterr().err == ""
