from __future__ import annotations

from kornia_tidy.lab.file_jobs import Row, table, work_on_all
from tests.base import BaseTester


class TestWorkOnAll(BaseTester):
    def test_feature_rows_are_in_the_order_of_the_files_and_errors_are_results(self, capsys):
        def work(path, progress):
            progress(1, 2)
            if path == "b":
                raise ValueError("b is\nempty")
            return Row(path, "done")

        rows = work_on_all("measure", ["a", "b", "c"], work)
        assert rows == [Row("a", "done"), Row("b", "b is empty"), Row("c", "done")]
        assert "kornia-tidy: error: b is empty" in capsys.readouterr().err

    def test_feature_results_of_a_table_stand_below_each_other(self):
        head, *lines = table([Row("a.dng", "done", "60 x 40", 1.25), Row("long/name.dng", "kept")])
        assert [line.index(word) for line, word in zip(lines, ("done", "kept"), strict=True)] == [
            head.index("result")
        ] * 2
