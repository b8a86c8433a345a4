"""Text files as editors on other systems save them: with a byte order mark, in UTF-8, UTF-16 or UTF-32."""

from __future__ import annotations

import pytest

from kornia_tidy.files import read_text
from tests.base import BaseTester
from tests.mutations.readers import make_readers
from tests.mutations.reading import try_read

FORMS = {"utf-8-sig": b"", "utf-16": b"", "utf-32": b"", "utf-16-be": b"\xfe\xff"}  # and the mark that is to be added


class TestTextFiles(BaseTester):
    def test_feature_every_reader_of_text_takes_a_byte_order_mark(self, tmp_path):
        """Lenses have encodings of their own: tests/optics/lens/test_prescription_files.py."""
        (tmp_path / "whole").mkdir()
        readers = make_readers(tmp_path / "whole")
        cases = [case for kind, cases in readers.items() for case in cases if kind != "lens"]
        texts = [case for case in cases if case.damage in {"text", "json"} or case.kind == "response"]
        assert len(texts) > 10
        for case in texts:
            text = case.source.read_bytes().decode()
            for form, mark in FORMS.items():
                assert try_read(case, mark + text.encode(form), tmp_path) == ("accepted", ""), (case.source, form)

    def test_exception_what_is_no_text(self, tmp_path):
        for data, name in ((b"epoch\n\xff\n", "UTF-8"), (b"\xff\xfea", "UTF-16"), (b"\xff\xfe\0\0\xff", "UTF-32")):
            (tmp_path / "log.csv").write_bytes(data)
            with pytest.raises(ValueError, match=rf"cannot read .*log\.csv: it is no text in {name} "):
                read_text(tmp_path / "log.csv")
