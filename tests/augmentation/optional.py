"""Optional packages of the adapters: imported, or the tests skipped with the reason."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest
import torch

OPERATORS = ("nms", "qnms", "roi_align", "qroi_align", "roi_pool", "ps_roi_align", "ps_roi_pool", "deform_conv2d")
BACKWARDS = ("roi_align", "roi_pool", "ps_roi_align", "ps_roi_pool", "deform_conv2d")
_LIBRARIES = []


def need_torchvision(module: bool = True) -> None:
    """Make torchvision importable, or skip the module's tests, or with ``module=False`` the one that runs.

    The wheel of PyPI is built for CUDA. Beside a build of torch for the CPU its operators, such as torchvision::nms,
    are not registered, and the import ends in an error. No transform uses them: their names are registered here, with
    a schema that fits none of them, so that the transforms can be imported.
    """
    if importlib.util.find_spec("torchvision") is None:
        pytest.skip("torchvision is not installed", allow_module_level=module)
    if "torchvision" in sys.modules:
        return
    works = subprocess.run([sys.executable, "-c", "import torchvision"], capture_output=True, check=False)
    if works.returncode:
        library = torch.library.Library("torchvision", "DEF")
        for name in (*OPERATORS, *(f"_{name}_backward" for name in BACKWARDS)):
            library.define(f"{name}(Tensor x) -> Tensor")
        _LIBRARIES.append(library)  # freed, it would take the operators along


def need(package: str, module: bool = True) -> None:
    """Skip the tests of a module, or with ``module=False`` the one that runs, unless a package is installed."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed", allow_module_level=module)
