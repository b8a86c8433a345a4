"""References of docstrings to Python objects: public ones become links, others plain text if they exist.

Docstrings name objects as their own module sees them, such as ``thin_lens_defocus`` or
``kornia_tidy.optics.thin_lens.thin_lens_defocus``. The site describes an object once, under the package
that exports it.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
import sys
from collections import defaultdict
from types import ModuleType
from typing import Any

import kornia_tidy


def resolve(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Return a link to a public object, plain text for another one that exists, None (a warning) for a missing one."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"].lstrip("~.")
    domain = env.domains["py"]
    for name in full_names(target):
        for described in aliases().get(name, (name,)):
            if described in domain.objects and described != node["reftarget"]:
                kind = "mod" if domain.objects[described].objtype == "module" else "obj"
                return domain.resolve_xref(env, node["refdoc"], app.builder, kind, described, node, contnode)
    mocked = target.partition(".")[0] in app.config.autodoc_mock_imports
    return contnode if mocked or full_names(target) or exists(target, node.get("py:module")) else None


def full_names(target: str) -> list[str]:
    """Return the full names that a docstring may mean; more than one only if modules share a name."""
    modules, index = defined()
    if target in modules:
        return [target]
    return index.get(target, [])


@functools.cache
def defined() -> tuple[dict[str, ModuleType], dict[str, list[str]]]:
    """Return all modules of the package, and for each ending of a name the full names that end so."""
    modules, index = {"kornia_tidy": kornia_tidy}, defaultdict(list)
    for info in pkgutil.walk_packages(kornia_tidy.__path__, "kornia_tidy."):
        if info.name in sys.modules or not info.name.endswith("__main__"):
            try:
                modules[info.name] = importlib.import_module(info.name)
            except (ImportError, RuntimeError):  # an adapter of a package that is missing, or does not fit torch
                continue
    for module_name, module in modules.items():
        for name, value in list(vars(module).items()):
            if name.startswith("__") or getattr(value, "__module__", module_name) != module_name:
                continue
            own = [name]
            if isinstance(value, type):
                own += [f"{name}.{member}" for parent in value.__mro__ for member in members(parent)]
            for one in dict.fromkeys(own):
                index[one].append(f"{module_name}.{one}")
                index[f"{module_name}.{one}"].append(f"{module_name}.{one}")
                if "." in one:
                    index[one.partition(".")[2]].append(f"{module_name}.{one}")
    return modules, index


def members(kind: type) -> set[str]:
    """Return the names in a class's body, annotated fields with them."""
    return set(vars(kind)) | set(vars(kind).get("__annotations__", ()))


@functools.cache
def aliases() -> dict[str, list[str]]:
    """Return the names under which packages export an object, by the name of where it is defined."""
    modules, _ = defined()
    found = defaultdict(list)
    for package, module in modules.items():
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            home = getattr(value, "__module__", package)
            found[f"{home}.{name}"].append(f"{package}.{name}")
            if isinstance(value, type):
                for member in {member for parent in value.__mro__ for member in members(parent)}:
                    found[f"{home}.{name}.{member}"].append(f"{package}.{name}.{member}")
    for names in found.values():
        names.sort(key=lambda name: name.count("."), reverse=True)
    return found


def exists(target: str, module: str | None) -> bool:
    """Tell whether a name can be imported, or is known in a module: torch.Tensor, Tensor, int."""
    if hasattr(sys.modules.get(module or "builtins"), target.partition(".")[0]):
        return True
    for prefix in ("", "builtins.", "typing.", "collections.abc.", "torch.", "matplotlib.figure."):
        try:
            pkgutil.resolve_name(prefix + target)
        except (ImportError, AttributeError, ValueError):
            continue
        return True
    return False
