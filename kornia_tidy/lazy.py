"""Names of a package, imported when they are first asked for: its settings can be read without torch."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any


def importer(package: str, modules: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package, which imports a public name or a module when it is asked for.

    Args:
        package: its name.
        modules: public names by the module of the package that defines them.

    Returns:
        A function from a name to its value.

    Raises:
        AttributeError: from that function, if the package has no such name.

    Convention:
        A public name that its module shares means the name, not the module, whatever was imported before.

    Example:
        >>> importer("kornia_tidy", {"optics.spectrum": ["REFERENCE_WAVELENGTH"]})("REFERENCE_WAVELENGTH")
        5.3e-07
    """
    homes = {name: module for module, names in modules.items() for name in names}

    class Package(ModuleType):
        """A package that no import of a module gives the module under a public name."""

        def __setattr__(self, name: str, value: Any) -> None:
            if not (name in homes and isinstance(value, ModuleType)):
                super().__setattr__(name, value)

    sys.modules[package].__class__ = Package

    def asked_for(name: str) -> Any:
        if name in homes:
            value = getattr(import_module(f"{package}.{homes[name]}"), name)
        elif not name.startswith("_") and find_spec(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)
        return value

    return asked_for
