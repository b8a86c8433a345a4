from __future__ import annotations

import threading

import pytest

from kornia_tidy.lab.file_jobs import Row, table, work_on_all
from tests.base import BaseTester


class TestWorkOnAll(BaseTester):
    @pytest.mark.parametrize("jobs", [1, 3])
    def test_feature_rows_are_in_the_order_of_the_files_and_errors_are_results(self, jobs, capsys):
        def work(path, progress):
            progress(1, 2)
            if path == "b":
                raise ValueError("b is\nempty")
            return Row(path, "done")

        rows = work_on_all("measure", ["a", "b", "c"], work, jobs)
        assert rows == [Row("a", "done"), Row("b", "b is empty"), Row("c", "done")]
        assert "kornia-tidy: error: b is empty" in capsys.readouterr().err

    def test_feature_an_interrupt_ends_the_others_at_their_next_tile(self):
        begun, ended = threading.Event(), []

        def work(path, progress):
            if path == "a":
                begun.wait(10)
                raise KeyboardInterrupt
            begun.set()
            try:
                for tile in range(10_000):
                    progress(tile, 10_000)
                    threading.Event().wait(0.001)
            except KeyboardInterrupt:
                ended.append(path)
                raise
            return Row(path, "done")

        with pytest.raises(KeyboardInterrupt):
            work_on_all("measure", ["a", "b", "c"], work, jobs=2)
        assert ended in (["b"], ["b", "c"], ["c", "b"])  # c may have begun before the interrupt

    def test_feature_results_of_a_table_stand_below_each_other(self):
        head, *lines = table([Row("a.dng", "done", "60 x 40", 1.25), Row("long/name.dng", "kept")])
        assert [line.index(word) for line, word in zip(lines, ("done", "kept"), strict=True)] == [
            head.index("result")
        ] * 2
