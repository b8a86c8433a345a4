"""Imports of packages under the names that they had before version 0.2, with a warning that gives the new name."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "accuracy.plan": "accuracy.planning.plan",
    "accuracy.planner": "accuracy.planning.planner",
    "accuracy.render_plan": "accuracy.planning.render_plan",
    "app": "cli.app",
    "app.controls": "cli.app.settings",
    "calibration": "lab.calibration",
    "camera.image_types": "arrays",
    "cli.app.controls": "cli.app.settings",
    "coded_datasets": "training.coded_datasets",
    "commands": "cli.commands",
    "data.opencv_arrays": "arrays",
    "inference": "reconstruction",
    "inference.capture_file": "lab.capture_file",
    "inference.compared_cameras": "design.compared_cameras",
    "inference.measured": "lab.measured",
    "lab.raw.dng_file": "lab.raw.dng_writer",
    "mask_design": "design",
    "mask_export": "lab.mask_export",
    "planning": "accuracy",
    "raw": "lab.raw",
    "scene_statistics": "data",
    "systems": "optics",
    "tradeoff": "design.tradeoff",
}
"""Old names of packages and modules of ``kornia_tidy``, and the new ones. Modules inside a package moved with it."""


def new_name(old: str) -> str | None:
    """Return the present name of a module, or None if it has not moved.

    Example:
        >>> new_name("kornia_tidy.raw.color"), new_name("kornia_tidy.masks")
        ('kornia_tidy.lab.raw.color', None)
    """
    package, _, inner = old.partition(".")
    parts = inner.split(".")
    for count in range(len(parts), 0, -1):
        if package == "kornia_tidy" and (found := MOVED.get(".".join(parts[:count]))) is not None:
            return ".".join((package, found, *parts[count:]))
    return None


class MovedModules(MetaPathFinder, Loader):
    """Finder of modules by their old names.

    Python asks it first: the finder of files would load a module inside a package that moved a second time.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a spec for a module that moved, or None."""
        return None if new_name(fullname) is None else ModuleSpec(fullname, self, is_package=True)

    def exec_module(self, module: ModuleType) -> None:
        """Put the moved module itself in the place of the empty one, and warn of the names in :data:`MOVED`."""
        old = module.__name__
        new = new_name(old)
        assert new is not None
        sys.modules[old] = import_module(new)
        if old.partition(".")[2] in MOVED:
            warnings.warn(f"{old} is now {new}", FutureWarning, stacklevel=2)
