"""Names of a package, imported when they are first asked for: its settings can be read without torch."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

_IMPORT = re.compile(r"^    from (kornia_tidy\.[\w.]+) import (\([^)]*\)|.+)$", re.MULTILINE)


def importer(package: str) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package, which imports a public name or a module when it is asked for.

    Args:
        package: its name. The imports below ``if TYPE_CHECKING:`` in its file say which module defines a public name.

    Returns:
        A function from a name to its value.

    Raises:
        AttributeError: from that function, if the package has no such name.

    Convention:
        A public name that its module shares means the name, not the module, whatever was imported before.

    Example:
        >>> importer("kornia_tidy.design")("MOST_MASKS")
        Traceback (most recent call last):
        ...
        AttributeError: module 'kornia_tidy.design' has no attribute 'MOST_MASKS'
    """
    module: Any = sys.modules[package]
    source = module.__spec__.loader.get_source(package)
    homes = {name: home for home, names in _IMPORT.findall(source) for name in re.findall(r"\w+", names)}

    class Package(ModuleType):
        """A package that no import of a module gives the module under a public name."""

        def __setattr__(self, name: str, value: Any) -> None:
            if not (name in homes and isinstance(value, ModuleType)):
                super().__setattr__(name, value)

    module.__class__ = Package

    def asked_for(name: str) -> Any:
        if name in homes:
            value = getattr(import_module(homes[name]), name)
        elif not name.startswith("_") and find_spec(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(module, name, value)
        return value

    return asked_for
