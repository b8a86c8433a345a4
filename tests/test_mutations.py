"""A few damaged files of each kind through the command; `make mutations` takes more, see tests/mutations."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.base import BaseTester
from tests.mutations.damage import damaged
from tests.mutations.forked import prepare, run
from tests.mutations.pristine import make_cases

KINDS = ("npy", "png", "tiff", "pfm", "jpeg", "safetensors", "checkpoint", "rgbd.json", "sidecar")


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    return make_cases(tmp_path_factory.mktemp("whole"))


@pytest.fixture(autouse=True)
def _one_thread():
    """Threads do not live on in a fork."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class TestMutations(BaseTester):
    @pytest.mark.parametrize("kind", KINDS)
    def test_smoke_whole_files_are_accepted(self, kind, cases, tmp_path):
        for number, case in enumerate(cases[kind]):
            folder = tmp_path / str(number)
            outcome = run(case, prepare(case, case.source.read_bytes(), folder), folder)
            assert (outcome.status, outcome.faults) == (0, ()), outcome.told

    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_damaged_files_are_read_or_refused_in_one_sentence(self, kind, cases, tmp_path):
        for number in range(3):
            generator = np.random.default_rng([7, number])
            case = cases[kind][number % len(cases[kind])]
            how, data = damaged(case.source.read_bytes(), case.damage, generator)
            folder = tmp_path / str(number)
            outcome = run(case, prepare(case, data, folder), folder)
            assert outcome.faults == (), (how, outcome.told)
