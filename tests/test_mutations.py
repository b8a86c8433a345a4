"""A few damaged files of each kind; `make fuzz` takes more, see tests/mutations."""

from __future__ import annotations

import pytest

from tests.base import BaseTester
from tests.mutations.readers import SHARES, make_readers
from tests.mutations.reading import read_all, shared_out

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return make_readers(tmp_path_factory.mktemp("readers"))


class TestReaders(BaseTester):
    @pytest.mark.filterwarnings("ignore:.* is stored ")  # turned, as some of the TIFF files are
    def test_smoke_whole_files_are_accepted(self, readers):
        for kind, cases in readers.items():
            for case in cases:
                if kind != "weights":  # those of a network of 21 million numbers are no small file
                    case.read(case.source)

    @pytest.mark.takes_seconds
    def test_feature_damaged_files_are_read_or_refused_in_a_sentence(self, readers, tmp_path):
        quick = [kind for kind in readers if SHARES.get(kind, 1) >= 1]
        for kind, count in shared_out(100, quick).items():
            results = list(read_all(readers[kind], 11, range(count), tmp_path))
            assert [number for number, *_ in results] == list(range(count))
            assert not [read[:3] for read in results if read[1] == "failed"], kind
