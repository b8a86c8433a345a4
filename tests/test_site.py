"""The scripts that make the site of the documentation: gallery, pages of the API reference, and docstrings."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from collections import defaultdict
from pathlib import Path

import pytest

import kornia_tidy
from kornia_tidy.data import read_image
from tests.base import BaseTester

SITE = Path(__file__).resolve().parents[1] / "docs" / "site"
EXAMPLE = '''"""A question. Two sentences.

What follows the first paragraph.

    python examples/{stem}.py --size 8
"""


def main(arguments):
    print("arguments", arguments)
    return {returned}
'''


def load(name):
    """Import a script of docs/site under a name of its own."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", SITE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


gallery, api_pages, flowchart = load("gallery"), load("api_pages"), load("flowchart")


@pytest.fixture
def example(tmp_path):
    """A function that writes an example with a result, and returns its path."""
    (tmp_path / "examples").mkdir()

    def write(returned, stem="my_example"):
        path = tmp_path / "examples" / f"{stem}.py"
        path.write_text(EXAMPLE.format(stem=stem, returned=returned), encoding="utf-8")
        return path

    return write


class TestGallery(BaseTester):
    def make(self, tmp_path, example, *, run=True):
        gallery.write_gallery(tmp_path / "pages", tmp_path / "results", [example], run=run)
        return (tmp_path / "pages" / f"{example.stem}.md").read_text(encoding="utf-8")

    @pytest.mark.parametrize(("returned", "picture"), [("[3.0, 2.0, 1.0]", "loss"), ("None", None)])
    def test_smoke_a_page_has_words_command_output_and_script(self, tmp_path, example, returned, picture):
        pytest.importorskip("matplotlib", reason="losses are drawn with matplotlib")
        page = self.make(tmp_path, example(returned))
        assert page.startswith("# My example\n\nA question. Two sentences.\n\nWhat follows the first paragraph.\n")
        assert "```bash\npython examples/my_example.py --size 8\n```" in page
        assert page.count("--size 8") == 1  # not among the words, too
        assert "## What it prints\n\n```bash\npython examples/my_example.py\n```\n```text\narguments []\n```" in page
        assert "```{literalinclude} my_example.py" in page
        pictures = re.findall(r"!\[(\w+)\]\((\S+)\)", page)
        assert [name for name, _ in pictures] == ([picture] if picture else [])
        assert all(read_image(tmp_path / "pages" / file).shape[0] == 3 for _, file in pictures)
        card = [":::{grid-item-card} My example", ":link: my_example", ":link-type: doc"]
        card += [f":img-top: images/my_example-{name}.png\n:img-alt: My example" for name, _ in pictures]
        instead = [] if pictures else ["```text", "arguments []", "```"]
        index = (tmp_path / "pages" / "index.md").read_text(encoding="utf-8")
        assert "\n".join([*card, "", "A question. Two sentences.", *instead, ":::"]) in index

    def test_feature_titles_and_arguments_are_of_examples_that_are_there(self):
        there = {path.stem for path in (SITE.parents[1] / "examples").glob("*.py")}
        assert set(gallery.TITLES) == there
        assert set(gallery.ARGUMENTS) <= there


class TestApiPages(BaseTester):
    def test_feature_each_public_name_is_on_one_page(self, tmp_path):
        """As Sphinx writes the pages: a package's list of names, and single names of modules."""
        root = SITE.parents[1]
        given = [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "examples").glob("*.py")]
        api_pages.write_api_pages(tmp_path / "api", given)
        homes = [api_pages.home(name) for name in kornia_tidy.__all__]
        places = defaultdict(list)
        for path in (tmp_path / "api").glob("*.rst"):
            text = path.read_text(encoding="utf-8")
            for name, listed in re.findall(r"automodule:: (\S+)\n(   :imported-members:)?", text):
                own = [home for home in homes if home.rpartition(".")[0] == name]
                exported = getattr(importlib.import_module(name), "__all__", ()) if listed else ()
                for public in {*own, *(f"{name}.{public}" for public in exported)}:
                    places[public].append(path.stem)
            for module, name in re.findall(r"auto(?:class|function|data):: (\S+)::(\S+)", text):
                places[f"{module}.{name}"].append(path.stem)
        packages = [info.name for info in pkgutil.walk_packages(kornia_tidy.__path__, "kornia_tidy.") if info.ispkg]
        public = {
            f"{package}.{name}"
            for package in packages
            if package.split(".")[1] not in api_pages.LEFT_OUT
            for name in getattr(importlib.import_module(package), "__all__", ())
        }
        assert len(public) > 100
        assert {name: places[name] for name in public if len(places[name]) != 1} == {}
        assert {name: pages for name, pages in places.items() if len(pages) > 1} == {}
        assert [name for name in homes if len(places[name]) != 1] == []
