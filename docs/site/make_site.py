"""Build the site of the documentation into outputs/site: all pages, the gallery of examples and the API reference.

    python docs/site/make_site.py                # runs the examples that have changed: some minutes at first
    python docs/site/make_site.py --no-gallery   # does not run examples; pages of the gallery show pictures of before
    python docs/site/make_site.py --linkcheck    # also asks the addresses of external links

Every warning is an error: a link, an anchor or a reference that leads nowhere ends the build with status 1.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

SITE = Path(__file__).resolve().parent
ROOT = SITE.parents[1]
sys.path[:0] = [str(SITE), str(ROOT)]

from api_pages import write_api_pages  # noqa: E402
from gallery import write_gallery  # noqa: E402
from sphinx.cmd.build import main as sphinx  # noqa: E402

PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
LINK = re.compile(r"\]\(([^)#:\s]+)\)")  # target of a link of Markdown inside the repository


def main(arguments: Sequence[str] | None = None) -> int:
    """Copy the pages beside each other, write the generated ones, and build the site."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-gallery", action="store_true", help="run no example")
    parser.add_argument("--linkcheck", action="store_true", help="ask for external links, too")
    parser.add_argument("--output", type=Path, default=ROOT / "outputs", help="folder of the site and of what it is of")
    options = parser.parse_args(arguments)

    output = options.output.resolve()
    source = output / "site-source"
    pages = copy_pages(source)
    examples = sorted((ROOT / "examples").glob("*.py"))
    write_gallery(source / "gallery", output / "gallery", examples, run=not options.no_gallery)
    write_api_pages(source / "api", [*pages, *examples])

    strict = ["-c", str(SITE), "--fail-on-warning", "--nitpicky", "--fresh-env", "--quiet"]
    for builder in ["html", "linkcheck"] if options.linkcheck else ["html"]:
        target = output / ("site" if builder == "html" else builder)
        status = sphinx([*strict, "-b", builder, str(source), str(target)])
        if status:
            return status
    print(f"{output / 'site' / 'index.html'}")
    return 0


def copy_pages(source: Path) -> list[Path]:
    """Copy pages and their link targets in the repository, so that links hold, and drop files that are gone from it."""
    listed = [ROOT / name for name in PAGES] + [
        path for path in (ROOT / "docs").rglob("*") if path.suffix in {".md", ".png", ".jpg", ".svg", ".webp"}
    ]
    pages = [path for path in listed if path.suffix == ".md"]
    linked = {(page.parent / target).resolve() for page in pages for target in LINK.findall(page.read_text())}
    inside = {path for path in linked if path.is_file() and path.is_relative_to(ROOT)}
    copied = {source / path.relative_to(ROOT): path for path in {*listed, *inside}}
    copied[source / "index.rst"] = SITE / "index.rst"
    for old in [*source.glob("*"), *(source / "docs").rglob("*")]:
        if old.is_file() and old not in copied:
            old.unlink()
    for new, path in copied.items():
        new.parent.mkdir(parents=True, exist_ok=True)
        if not new.exists() or new.read_bytes() != path.read_bytes():
            shutil.copyfile(path, new)
    return pages


if __name__ == "__main__":
    sys.exit(main())
