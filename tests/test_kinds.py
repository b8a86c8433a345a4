"""kornia's kinds of test for every public operation on tensors, in four data types; and that none is left out."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

import kornia_tidy
from tests.base import BaseTester
from tests.operations import OPERATIONS, Call, Operation

TESTS = Path(__file__).parent
KINDS = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
every_operation = pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())


def argument(operation: Operation, count: int = 2, dtype: torch.dtype = torch.float32) -> Tensor:
    low, high = operation.ends
    drawn = torch.rand(count, *operation.shape, generator=torch.Generator().manual_seed(count))
    return (low + (high - low) * drawn).to(dtype)


def bound(operation: Operation, given: Tensor) -> Call:
    """The operation with all else bound, and the same masks in each call."""
    torch.manual_seed(7)
    return operation.make(given)


@every_operation
class TestEveryOperation(BaseTester):
    @pytest.mark.parametrize("kind", KINDS, ids=lambda kind: str(kind).removeprefix("torch."))
    def test_smoke_four_data_types_of_which_halves_are_float32_rounded_once(self, operation, kind):
        given = argument(operation, dtype=kind)
        if operation.halves and kind.itemsize < 4:
            with pytest.raises(ValueError, match=operation.halves):
                bound(operation, given)(given)
            return
        wide = given.to(torch.promote_types(kind, torch.float32))
        found, expected = bound(operation, given)(given).detach(), bound(operation, wide)(wide).detach()
        assert found.isfinite().all()
        assert found.dtype == (wide.dtype if operation.wide else kind)
        unit = torch.finfo(found.dtype).eps
        self.assert_close(found, expected.to(found.dtype), rtol=unit, atol=unit * float(expected.abs().max()))

    @pytest.mark.parametrize("count", [0, 1, 3])
    def test_cardinality(self, operation, count):
        count = max(count, operation.least)
        given = argument(operation, count)
        assert bound(operation, given)(given).shape == (count, *(operation.out or operation.shape))

    def test_exception_whole_numbers(self, operation):
        given = argument(operation)
        if operation.allows:
            pytest.skip(operation.allows)
        with pytest.raises(TypeError, match=operation.error) as raised:
            bound(operation, given)(given.to(torch.uint8))
        assert "\n" not in str(raised.value)

    def test_gradcheck(self, operation):
        if operation.stepped:
            pytest.skip(operation.stepped)
        given = argument(operation, 1, torch.float64)
        self.gradcheck(bound(operation, given), (given,))


class TestEveryCompiledOperation(BaseTester):
    @pytest.mark.parametrize(
        "operation",
        [
            pytest.param(one, id=name, marks=pytest.mark.slow if one.slow_to_compile else pytest.mark.takes_seconds)
            for name, one in OPERATIONS.items()
        ],
    )
    @pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
    @pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
    @pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # by the compiler itself
    def test_dynamo(self, operation):
        given = argument(operation)
        call = bound(operation, given)
        self.assert_close(torch.compile(call, backend="eager")(given), call(given))


def public_names() -> dict[str, str]:
    """Name and package of everything that a package of kornia_tidy exports and that can be called."""
    packages = [kornia_tidy.__name__]
    packages += [found.name for found in pkgutil.walk_packages(kornia_tidy.__path__, "kornia_tidy.") if found.ispkg]
    modules = {name: importlib.import_module(name) for name in packages}
    return {
        name: package
        for package, module in modules.items()
        for name in getattr(module, "__all__", ())
        if callable(getattr(module, name))
    }


def kinds_elsewhere(name: str) -> set[str]:
    """Kinds of the tests in files that are about a name: it stands in two lines or more."""
    return set().union(*(kinds for lines, kinds in lines_and_kinds() if lines[name] > 1))


@cache
def lines_and_kinds() -> list[tuple[Counter[str], set[str]]]:
    """Of each file: in how many lines each word stands, and the kinds of its tests."""
    texts = [path.read_text() for path in sorted(TESTS.rglob("test_*.py")) if path != Path(__file__)]
    return [
        (
            Counter(word for line in text.splitlines() for word in set(re.findall(r"\w+", line))),
            set(re.findall(r"def test_([a-z]+)", text)),
        )
        for text in texts
    ]


RECORD = "what a function returns: it checks nothing of its own"
REFUSES_NOTHING = "takes what functions of the same package made and checked"
EXEMPT = {
    "Conditions": ({"exception"}, RECORD),
    "DatasetTransform": ({"feature", "exception"}, "tested as camera.as_transform: test_pipelines_dataloader.py"),
    "DepthAugmentation": ({"feature", "exception"}, "abstract: tested as RandomTiDyOptics, test_depth_augmentation.py"),
    "DepthMap": ({"feature", "exception"}, RECORD),
    "FrameTime": ({"feature", "exception"}, RECORD),
    "JointEstimate": ({"feature", "exception"}, RECORD),
    "MaskFit": ({"exception"}, RECORD),
    "RenderPlan": ({"feature", "exception"}, RECORD),
    "ResolvedPSF": ({"feature", "exception"}, RECORD),
    "Restoration": ({"feature", "exception"}, RECORD),
    "System": ({"feature", "exception"}, "plain data: tested as the entries of SYSTEMS, test_published_systems.py"),
    "TradeRow": ({"feature", "exception"}, RECORD),
    "depth_at": ({"exception"}, REFUSES_NOTHING),
    "draw_depth": ({"exception"}, REFUSES_NOTHING),
    "register": ({"exception"}, REFUSES_NOTHING),
    "resolve_psf": ({"exception"}, REFUSES_NOTHING),
}


class TestPublicNames(BaseTester):
    def test_feature_each_has_tests_of_its_results_and_of_its_errors(self):
        """A name that is exempt is listed above with the kinds that it lacks, so that the list stays true."""
        names, lacking = set(public_names()), {}
        for name in names - set(OPERATIONS):
            kinds = kinds_elsewhere(name)
            lacks = {"exception"} - kinds
            if not kinds & {"feature", "smoke", "cardinality"}:
                lacks.add("feature")
            if lacks:
                lacking[name] = lacks
        assert lacking == {name: lacks for name, (lacks, _) in EXEMPT.items()}
        assert names >= set(OPERATIONS)
