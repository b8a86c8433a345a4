"""Fixtures and options shared by all tests: device and dtype by option or environment, seeds, slow tests."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

gc.disable()  # until all is imported: a quarter of that time was spent in looking for garbage

settings.register_profile("any machine", settings(), deadline=None)  # tests are not timed: other work may slow them
settings.load_profile("any machine")

DTYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32, "float64": torch.float64}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default=os.environ.get("KORNIA_TEST_DEVICE", "cpu"), help="cpu, cuda or all")
    parser.addoption(
        "--dtype", default=os.environ.get("KORNIA_TEST_DTYPE", "float32,float64"), help="comma list or all"
    )
    parser.addoption("--runslow", action="store_true", help="run tests marked slow or takes_seconds too")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" in metafunc.fixturenames:
        wanted = metafunc.config.getoption("--device")
        devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])] if wanted == "all" else [wanted]
        metafunc.parametrize("device", [torch.device(d) for d in devices], ids=str)
    if "dtype" in metafunc.fixturenames:
        wanted = metafunc.config.getoption("--dtype")
        names = list(DTYPES) if wanted == "all" else wanted.split(",")
        metafunc.parametrize("dtype", [DTYPES[n] for n in names], ids=names)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--runslow"):
        for item in items:
            for mark in ("slow", "takes_seconds"):
                if mark in item.keywords:
                    item.add_marker(pytest.mark.skip(reason=f"{mark}: run with --runslow"))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Garbage is looked for among what the tests make, not among a million objects that live as long as they."""
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000)
        gc.enable()


@pytest.fixture(autouse=True, scope="module")
def _forked_decoding(request: pytest.FixtureRequest) -> Iterator[None]:
    """Modules that name RawCapture have raw files decoded by forks of one process, in a tenth of the time."""
    if "RawCapture" not in vars(request.module) or "hostile" in request.module.__name__ or sys.platform != "linux":
        yield
        return
    from tests.lab.raw.forked import forked_decoding

    with forked_decoding():
        yield


# torch.manual_seed notes the whole stack for devices that are not used yet, which takes longer than most tests.
seed_torch = torch.manual_seed if torch.cuda.is_available() else torch.default_generator.manual_seed


@pytest.fixture(autouse=True, scope="module")
def _seed_of_module() -> None:
    """Fixtures of a module draw the same whatever ran before."""
    seed_torch(0)


@pytest.fixture(autouse=True)
def _seed(request: pytest.FixtureRequest) -> None:
    seed_torch(0)
    if "dynamo" in request.node.name:
        torch.compiler.reset()  # compilations of other tests would affect its guesses of dynamic shapes


@pytest.fixture
def one_thread() -> Iterator[None]:
    """One thread, because threads do not live on in a fork."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
