"""Every public module of torch: it can be printed, copied and pickled."""

from __future__ import annotations

import copy
import importlib
import inspect
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from kornia_tidy import TiDyOptics, reconstruction
from kornia_tidy.optics.lens import made_lenses
from tests.base import BaseTester
from tests.reconstruction import test_joint_closed_form, test_layered_joint
from tests.test_kinds import public_names
from tests.test_public_on_accelerators import refocused


def network() -> reconstruction.NAFNet:
    return reconstruction.NAFNet(width=2)


ARGUMENTS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "AttentionUNet": lambda: (3, 1, 4),
    "DepthBlur": lambda: (0.6, 4.0, 10e-3, 4e-6),
    "DiffractionEfficiency": lambda: (0.9,),
    "GreyLevels": lambda: (4,),
    "JointHead": lambda: (test_joint_closed_form.joint(),),
    "LearnableDwellTimes": lambda: ((0.5, 0.5),),
    "LearnableAperture": lambda: (nn.Parameter(torch.rand(6, 6)),),
    "Lens": lambda: made_lenses.ideal_parts("own", "", lambda *x: 0 * x[2], (530e-9,), 50e-3, 8.0, 1.0, 7e-3),
    "LinearCamera": lambda: (TiDyOptics(sensor=None), torch.ones(1, 1, 40, 40)),
    "PixelCrosstalk": lambda: (0.3,),
    "Residual": lambda: (network(),),
    "SelfEnsemble": lambda: (network(),),
    "StrokeError": lambda: (0.9,),
    "Switching": lambda: (1e-3,),
}
MAKERS: dict[str, Callable[[], nn.Module]] = {
    "JointClosedFormHead": test_joint_closed_form.joint,
    "LayeredJointHead": test_layered_joint.layered,
    "Refocused": refocused,
}


def made(name: str, package: str) -> Callable[[], nn.Module]:
    kind = getattr(importlib.import_module(package), name)
    return MAKERS[name] if name in MAKERS else lambda: kind(*ARGUMENTS[name]() if name in ARGUMENTS else ())


MADE = {
    name: made(name, package)
    for name, package in sorted(public_names().items())
    if isinstance(kind := getattr(importlib.import_module(package), name), type)
    and issubclass(kind, nn.Module)
    and not inspect.isabstract(kind)
}


@pytest.mark.parametrize("name", MADE)
class TestEveryModule(BaseTester):
    def test_feature_is_printed_copied_and_pickled(self, name):
        module = MADE[name]()
        assert type(module).__name__ in repr(module)
        for twin in (copy.copy(module), copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
            assert repr(twin) == repr(module)
            for one, other in zip(twin.state_dict().values(), module.state_dict().values(), strict=True):
                assert torch.equal(one, other)
