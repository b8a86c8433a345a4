"""Draw which package imports which into docs/architecture.md, and list the packages there, from the code itself.

    python docs/make_architecture.py            # writes between the markers of docs/architecture.md
    python docs/make_architecture.py --check    # exit status 1 if that would change it, or a named file is missing

The order of the packages is that of the layers in .importlinter. An arrow that other arrows already imply is left out.
An import against the order is drawn dotted.
"""

from __future__ import annotations

import argparse
import ast
import configparser
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "kornia_tidy"
CORE = "core"  # the modules at the package's root
COMMAND_LINE = {"__main__": "cli"}  # it imports from the same packages as the topmost one
MADE = ("outputs/", "dist/")  # folders that make fills and git ignores
MADE_IN = "docs/architecture.md"
DOCUMENTS = ("CONTRIBUTING.md", "README.md", "docs/*.md")  # in which file names are checked

Arrows = dict[str, set[str]]


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Write docs/architecture.md, or check it."""
    description = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python docs/make_architecture.py", description=description)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 if something is stale")
    check = parser.parse_args(arguments).check
    document = root / MADE_IN
    before = document.read_text(encoding="utf-8")
    after = filled(before, parts(root))
    if not check:
        document.write_text(after, encoding="utf-8")
    wrong = ["docs/architecture.md is stale: run python docs/make_architecture.py"] if check and after != before else []
    for named in sorted(path for pattern in DOCUMENTS for path in root.glob(pattern)):
        wrong += [f"{named.relative_to(root)} names {path}, which is not there" for path in missing(root, named)]
    for sentence in wrong:
        sys.stderr.write(sentence + "\n")
    return int(bool(wrong))


def parts(root: Path) -> dict[str, str]:
    """Return the text that belongs between each pair of markers."""
    order = packages_in_order(root)
    arrows = imports(root / PACKAGE)
    return {"diagram": diagram(arrows, order), "packages": table(root / PACKAGE, order)}


def packages_in_order(root: Path) -> list[str]:
    """Return the packages from the bottom up, as .importlinter lists them."""
    contracts = configparser.ConfigParser()
    contracts.read(root / ".importlinter", encoding="utf-8")
    words = re.findall(r"\w+", contracts["importlinter:contract:layers"]["layers"])
    return [CORE, *(name for name in reversed(words) if (root / PACKAGE / name / "__init__.py").exists())]


def imports(package: Path) -> Arrows:
    """Return, for each package inside a package, which others it imports from; names beside them count as the core."""
    inside = {folder.parent.name for folder in package.glob("*/__init__.py")}
    arrows: Arrows = defaultdict(set)
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package).with_suffix("").parts
        if place != ("__init__",):  # of the package itself: public names, which come from everywhere
            source = _owner(place[0], inside)
            targets = {_owner(name, inside) for name in _imported(path, package.name)}
            arrows[source] |= targets - {source}
    return arrows


def _owner(name: str, inside: set[str]) -> str:
    return name if name in inside else COMMAND_LINE.get(name, CORE)


def _imported(path: Path, package: str) -> Iterator[str]:
    """Yield the first name below the package of each import of it, wherever it stands in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module]
        for module in modules:
            first, _, rest = module.partition(".")
            if first == package and rest:
                yield rest.partition(".")[0]


def diagram(arrows: Arrows, order: Sequence[str]) -> str:
    """Return a Mermaid flow chart of packages, from the top down."""
    rank = {name: place for place, name in enumerate(order)}
    down = {name: {other for other in arrows.get(name, ()) if rank[other] < rank[name]} for name in order}
    up = {name: {other for other in arrows.get(name, ()) if rank[other] > rank[name]} for name in order}
    lines = ["```mermaid", "flowchart TD"]
    for name in reversed(order):
        nearest_first = sorted(reduced(name, down), key=rank.__getitem__, reverse=True)
        lines += [f"    {name} --> {other}" for other in nearest_first]
        lines += [f"    {name} -. against the order .-> {other}" for other in sorted(up[name], key=rank.__getitem__)]
    return "\n".join([*lines, "```"])


def reduced(name: str, arrows: Arrows) -> set[str]:
    """Return the targets of a package that none of its other targets leads to.

    Example:
        >>> reduced("camera", {"camera": {"psf", "optics"}, "psf": {"optics"}, "optics": set()})
        {'psf'}
    """
    return {end for end in arrows[name] if not any(end in _reached(other, arrows) for other in arrows[name] - {end})}


def _reached(name: str, arrows: Arrows) -> set[str]:
    found: set[str] = set()
    waiting = [name]
    while waiting:
        fresh = arrows[waiting.pop()] - found
        found |= fresh
        waiting += fresh
    return found


def table(package: Path, order: Sequence[str]) -> str:
    """Return a table of the packages, from the bottom up, with the first sentence of each."""
    rows = ["| package | |", "|---|---|"]
    for name in order:
        if name == CORE:
            files = sorted(path for path in package.glob("*.py") if path.stem not in {"__init__", *COMMAND_LINE})
            rows += [f"| `{path.name}` | {first_sentence(path)} |" for path in files]
        else:
            rows.append(f"| `{name}/` | {first_sentence(package / name / '__init__.py')} |")
    return "\n".join(rows)


def first_sentence(path: Path) -> str:
    """Return the first sentence of a module's docstring, for a cell of a table."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    if not text:
        raise ValueError(f"{path} has no docstring: say in one sentence what it is for")
    sentence = re.split(r"(?<=[.!?])\s", " ".join(text.split("\n\n")[0].split()))[0]
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", sentence).replace("``", "`").replace("|", r"\|")


def filled(text: str, texts: dict[str, str]) -> str:
    r"""Return a document with new text between its markers.

    Example:
        >>> filled("a <!-- made: x --> old <!-- end: x --> b", {"x": "new"})
        'a <!-- made: x -->\nnew\n<!-- end: x --> b'
    """
    for name, made in texts.items():
        begin, end = f"<!-- made: {name} -->", f"<!-- end: {name} -->"
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise ValueError(f"docs/architecture.md must have the markers {begin} and {end} once each, in this order")
        head, tail = text.partition(begin)[0], text.partition(end)[2]
        text = f"{head}{begin}\n{made}\n{end}{tail}"
    return text


def missing(root: Path, document: Path) -> list[str]:
    """Return the paths that a document names, in backquotes or as links, and that do not exist.

    A path in backquotes has a slash, and ends with a suffix or with a slash. It begins at the root of the checkout or
    in the package. Paths with a placeholder, such as ``<name>.py``, and code blocks are left out.
    """
    text = document.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```|<!-- made: .*?<!-- end: ", "", text, flags=re.DOTALL | re.MULTILINE)
    quoted = [name for name in re.findall(r"`([\w.\-/]+)`", text) if re.search(r"/$|/[\w.\-]*\.\w+$", name)]
    quoted = [name for name in quoted if not name.startswith(MADE)]
    linked = [name for name in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text) if "://" not in name]
    gone = [name for name in quoted if not any((base / name).exists() for base in (root, root / PACKAGE))]
    gone += [name for name in linked if not (document.parent / name).exists()]
    return sorted(set(gone))


if __name__ == "__main__":
    sys.exit(main())
