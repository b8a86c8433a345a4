"""The API reference: one page for each package, made of its exported names and of what pages import by module."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from pathlib import Path

import kornia_tidy

WHOLE = ("training",)  # it exports nothing by itself: its modules are imported by name
LEFT_OUT = ("cli", "kernels", "figures")  # not for import, but by the command line
ADAPTERS = ("albumentations_v2", "arrays", "deepinv_physics", "torchvision_v2")
IMPORT = re.compile(r"^\s*from (kornia_tidy(?:\.\w+)*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)

INDEX = """API reference
=============

Units are SI. Image tensors are ``(B, C, H, W)`` in [0, 1], depth is ``(B, 1, H, W)`` in metres.

Import from ``kornia_tidy`` itself:

{names}

.. toctree::
   :maxdepth: 1
   :hidden:

   {pages}

.. list-table::
   :widths: 30 70

{rows}
"""


def write_api_pages(folder: Path, pages: list[Path]) -> None:
    """Write the index and the pages of all public packages; modules that the given pages import from are included."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = imports(pages)
    rows = []
    for info in pkgutil.iter_modules(kornia_tidy.__path__, "kornia_tidy."):
        short = info.name.rpartition(".")[2]
        if short in LEFT_OUT or not (info.ispkg or info.name in {"kornia_tidy.fidelity"}):
            continue
        summary = (importlib.import_module(info.name).__doc__ or "").strip().partition("\n")[0]
        rows.append((short, summary))
        write(folder / f"{short}.rst", package_page(info.name, wanted))
    names = ", ".join(f":py:obj:`~{home(name)}`" for name in kornia_tidy.__all__)
    table = "\n".join(f"   * - :doc:`kornia_tidy.{short} <{short}>`\n     - {summary}" for short, summary in rows)
    write(folder / "index.rst", INDEX.format(names=names, pages="\n   ".join(short for short, _ in rows), rows=table))


def home(name: str) -> str:
    """Return the name under which an object of the package's root is described."""
    value = getattr(kornia_tidy, name)
    package = ".".join(value.__module__.split(".")[:2])
    exported = name in getattr(importlib.import_module(package), "__all__", ())
    return f"{package}.{name}" if exported else f"{value.__module__}.{name}"


def package_page(package: str, wanted: dict[str, set[str]]) -> str:
    """Return the page of a package: its exports, its packages, then the names that pages import from its modules."""
    title = package.removeprefix("kornia_tidy.")
    lines = [title, "=" * len(title), "", *automodule(package)]
    module = importlib.import_module(package)
    exported = set(getattr(module, "__all__", ()))
    for info in pkgutil.walk_packages(getattr(module, "__path__", ()), f"{package}.", onerror=lambda _: None):
        short = info.name.rpartition(".")[2]
        names = sorted(wanted.get(info.name, set()) - exported)
        whole = title in WHOLE and info.name.rpartition(".")[0] == package
        if info.ispkg or whole or short in ADAPTERS:
            part = automodule(info.name)
        elif names:
            part = [line for name in names for line in described(info.name, name)]
        else:
            continue
        heading = info.name.removeprefix("kornia_tidy.")
        lines += ["", heading, "-" * len(heading), "", *part]
    return "\n".join(lines) + "\n"


def automodule(name: str) -> list[str]:
    """Return the directive that describes a module, and its exports where it lists them."""
    source = importlib.util.find_spec(name)
    text = Path(source.origin).read_text(encoding="utf-8") if source and source.origin else ""
    exports = name.rpartition(".")[2] not in ADAPTERS and re.search(r"^__all__\b", text, re.MULTILINE) is not None
    return [f".. automodule:: {name}", *["   :imported-members:"] * exports]


def described(module: str, name: str) -> list[str]:
    """Return the directive that describes one name of a module."""
    value = getattr(importlib.import_module(module), name)
    kind = "class" if isinstance(value, type) else "function" if callable(value) else "data"
    return [f".. auto{kind}:: {module}::{name}", ""]


def imports(pages: list[Path]) -> dict[str, set[str]]:
    """Return the names that pages and scripts import from each module."""
    found: dict[str, set[str]] = {}
    for page in pages:
        for module, names in IMPORT.findall(page.read_text(encoding="utf-8")):
            found.setdefault(module, set()).update(re.findall(r"\w+", re.sub(r" as \w+|#.*", "", names)))
    return found


def write(path: Path, text: str) -> None:
    """Write a page if its text is new, so that Sphinx reads it again only then."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
