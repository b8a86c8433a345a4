"""A few damaged files of each kind; `make mutations` and `make fuzz` take more, see tests/mutations."""

from __future__ import annotations

import numpy as np
import pytest

from tests.base import BaseTester
from tests.mutations.damage import damaged
from tests.mutations.forked import prepare, run
from tests.mutations.pristine import make_cases
from tests.mutations.readers import SHARES, make_readers
from tests.mutations.reading import read_all, shared_out

pytestmark = pytest.mark.usefixtures("one_thread")
KINDS = (
    "npy",
    "npz",
    "png",
    "tiff",
    "pfm",
    "pam",
    "jpeg",
    "safetensors",
    "checkpoint",
    "rgbd.json",
    "sidecar",
    "response",
)


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    return make_cases(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return make_readers(tmp_path_factory.mktemp("readers"))


class TestMutations(BaseTester):
    @pytest.mark.parametrize("kind", KINDS)
    def test_smoke_whole_files_are_accepted(self, kind, cases, tmp_path):
        for number, case in enumerate(cases[kind]):
            folder = tmp_path / str(number)
            outcome = run(case, prepare(case, case.source.read_bytes(), folder), folder)
            assert (outcome.status, outcome.faults) == (0, ()), outcome.told

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_damaged_files_are_read_or_refused_in_one_sentence(self, kind, cases, tmp_path):
        for number in range(3):
            generator = np.random.default_rng([7, number])
            case = cases[kind][number % len(cases[kind])]
            how, data = damaged(case.source.read_bytes(), case.damage, generator)
            folder = tmp_path / str(number)
            outcome = run(case, prepare(case, data, folder), folder)
            assert outcome.faults == (), (how, outcome.told)


class TestReaders(BaseTester):
    """In forks that read many files each; a command takes a fork for each file."""

    @pytest.mark.filterwarnings("ignore:.* is stored ")  # turned, as some of the TIFF files are
    def test_smoke_whole_files_are_accepted(self, readers):
        for kind, cases in readers.items():
            for case in cases:
                if kind != "weights":  # those of a network of 21 million numbers are no small file
                    case.command(case.source)

    @pytest.mark.takes_seconds
    def test_feature_damaged_files_are_read_or_refused_in_a_sentence(self, readers, tmp_path):
        quick = [kind for kind in readers if SHARES.get(kind, 1) >= 1]
        for kind, count in shared_out(100, quick).items():
            results = list(read_all(readers[kind], 11, range(count), tmp_path))
            assert [number for number, *_ in results] == list(range(count))
            assert not [read[:3] for read in results if read[1] == "failed"], kind
