"""Every block of code in the README, in docs/ and in CONTRIBUTING.md is run.

The blocks of a page are run in their order, in an empty folder. Python blocks share one namespace. Shell lines are
commands of `kornia-tidy`, given to its entry point, or of a checkout. A ```text block tells what the block before it
prints; ... in it stands for anything. Options of <!-- run with: OPTIONS --> are
appended to the commands of the block, to make them shorter. A block after <!-- slow: reason --> is run with --runslow;
without, its names are imported and its commands read their arguments. So do commands of make and of Python's modules
that stand in a sentence or a table.
"""

from __future__ import annotations

import ast
import contextlib
import doctest
import glob
import importlib
import importlib.util
import io
import re
import runpy
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from PIL import Image

from kornia_tidy.cli import main
from kornia_tidy.data import read_image
from tests.augmentation.optional import need_torchvision
from tests.base import BaseTester
from tests.data.published import write_each
from tests.page_commands import check_arguments, check_command, make_checkout, run_in_checkout
from tests.reconstruction.test_baselines import tiny

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "ecosystems").glob("*.md")),
    *sorted((ROOT / "docs" / "guides").glob("*.md")),
    *sorted((ROOT / "docs" / "record").glob("*.md")),
]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
PUBLISHED_NETWORKS = {
    "depth-anything-v2": "depth-anything/Depth-Anything-V2-Small-hf",
    "zoedepth": "Intel/zoedepth-nyu",
}  # made small in the folder, so that nothing is downloaded
RUN, SHOWN = ("python", "bash"), ("text", "mermaid", "json", "bibtex")
SLOW = [  # pages that take some seconds; .ci/run runs each page, with its slow blocks
    *(f"docs/{name}.md" for name in ("calibration", "capture", "command_line", "planning", "raw", "start")),
    *(f"docs/{name}.md" for name in ("systems", "trained_systems", "training", "when_coding_pays")),
    *(f"docs/guides/{name}.md" for name in ("capture_to_picture", "laboratory", "lens", "raw_files")),
]

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
MARKS = re.compile(r"(?:<!-- (?:needs|slow|run with): (?:(?!-->).)+ -->\n)+\Z", re.DOTALL)
MARK = re.compile(r"<!-- ([\w ]+): ((?:(?!-->).)+) -->", re.DOTALL)
COMMAND = re.compile(r"`((?:python -m tests\.|make )[^`]+)`")
LINK = re.compile(r"\]\(([^)\s]*?)(?:#([^)\s]*))?\)")


class Block(NamedTuple):
    """A block of code in a page."""

    page: str
    line: int
    language: str
    text: str
    needs: str = ""  # package, or folder beside the project, without which it is only compiled
    slow: bool = False  # run with --runslow alone
    options: str = ""  # appended to its commands where it is run

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def lacks(self) -> bool:
        """Whether what it needs is not on this machine."""
        if self.needs.startswith(".."):
            return not (ROOT / self.needs).exists()
        return bool(self.needs) and importlib.util.find_spec(self.needs) is None


def blocks(name: str, text: str) -> list[Block]:
    """Return the blocks of a page in their order."""
    found = []
    for fence in FENCE.finditer(text):
        before = text[: fence.start()]
        marks = MARKS.search(before)
        said = {kind: " ".join(words.split()) for kind, words in MARK.findall(marks[0])} if marks else {}
        found.append(
            Block(
                page=name,
                line=before.count("\n") + 1,
                language=fence[1],
                text=fence[2],
                needs=said.get("needs", ""),
                slow="slow" in said,
                options=said.get("run with", ""),
            )
        )
    return found


def shell_lines(block: Block) -> list[list[str]]:
    """Return the words of each command of a shell block; wildcards are files."""
    lines = [shlex.split(line, comments=True) for line in block.text.replace("\\\n", " ").splitlines()]
    return [[found for word in words for found in (sorted(glob.glob(word)) or [word])] for words in lines if words]


def run_page(name: str, text: str, *, slow: bool = False) -> None:
    """Run the blocks of a page in the current folder, slow ones on request; an error names the page and the line."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    printed: str | None = ""
    for block in blocks(name, text):
        if block.lacks:
            if block.language == "python":
                compile(block.text, str(ROOT / name), "exec")
            printed = None
        elif block.language == "text":
            if printed is not None:
                same = doctest.OutputChecker().check_output(
                    block.text, printed, doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
                )
                assert same, f"{block.place} shows\n{block.text}but printed is\n{printed}"
        elif block.language in RUN and (slow or not block.slow):
            if block.needs in ("torchvision", "deepinv"):
                need_torchvision()
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                if block.language == "python":  # the empty lines give errors the page's own line numbers
                    exec(compile("\n" * block.line + block.text, str(ROOT / name), "exec"), namespace)
                else:
                    run_shell(block)
            printed = out.getvalue()


def run_shell(block: Block) -> None:
    for line in shell_lines(block):
        words = [*line, *shlex.split(block.options)]
        if words[0] == "kornia-tidy":
            status = main(words[1:])
            assert status == 0, f"{block.place} ends with {status}: {shlex.join(words)}"
        else:
            check_arguments(words, block.place)
            if not Path("Makefile").exists():
                make_checkout(Path.cwd())
            print(run_in_checkout(words, Path.cwd(), block.place))


def check_names(block: Block) -> None:
    """Compile a Python block and import the names that it imports."""
    tree = ast.parse("\n" * block.line + block.text, block.place)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module or "")
            missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
            assert not missing, f"{block.place} imports {missing}, which {node.module} has not"


def anchors(page: Path) -> set[str]:
    """Return what links to the headings of a page end with, as GitHub makes them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder, which commands and scripts are run in: what a page reads, it has written."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["kornia-tidy"])
    torch.manual_seed(0)
    return tmp_path


class TestEveryPage(BaseTester):
    @pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*does not have many workers")  # Lightning
    @pytest.mark.filterwarnings("ignore::kornia_tidy.psf.AliasingWarning")  # of fidelity="paper", told in its page
    @pytest.mark.timeout(1200)  # with --runslow environments are made, and parts of the tests run
    @pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in NAMES])
    def test_feature_its_blocks_run_and_print_what_they_show(self, name, folder, request):
        if name == "docs/data_sets.md":
            write_each(folder)
        if name == "docs/trained_systems.md" and importlib.util.find_spec("transformers") is not None:
            for kind, place in PUBLISHED_NETWORKS.items():
                tiny(kind).network.save_pretrained(folder / place)
        run_page(name, (ROOT / name).read_text(encoding="utf-8"), slow=request.config.getoption("--runslow"))

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_what_is_seldom_run_names_what_is_there(self, name):
        for block in blocks(name, (ROOT / name).read_text(encoding="utf-8")):
            seldom = block.slow or block.lacks
            if seldom and block.language == "python":
                try:
                    check_names(block)
                except ImportError as error:
                    if not block.lacks or (error.name or "").partition(".")[0] != block.needs:
                        raise
            elif seldom and block.language == "bash":
                for words in shell_lines(block):
                    check_arguments([*words, *shlex.split(block.options)], block.place)

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_every_block_tells_its_language(self, name):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert [b.place for b in blocks(name, text) if b.language not in (*RUN, *SHOWN)] == []
        assert text.count("```") == 2 * len(blocks(name, text)), "a block is not closed, or is indented"

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_links_lead_somewhere(self, name):
        page = ROOT / name
        gone = []
        for file, anchor in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
            target = page.parent / file if file else page
            if "://" not in file and not (target.exists() and (not anchor or anchor in anchors(target))):
                gone.append(f"{file}#{anchor}")
        assert gone == []

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_links_to_headings_lead_to_pages(self, name):
        """Sphinx finds a heading only in a page of the site, and says so only once the whole site is built."""
        linked = LINK.findall(FENCE.sub("", (ROOT / name).read_text(encoding="utf-8")))
        aimed = {(ROOT / name).parent / file for file, anchor in linked if file and "://" not in file and anchor}
        assert {path.resolve() for path in aimed} <= set(PAGES)

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_commands_in_sentences_are_there(self, name):
        """They read their arguments if they have any; how they are told to start is enough of the others."""
        for line in COMMAND.findall(FENCE.sub("", (ROOT / name).read_text(encoding="utf-8"))):
            check_command(shlex.split(line), name)

    @pytest.mark.takes_seconds
    def test_feature_the_picture_of_the_readme_is_drawn(self, tmp_path):
        script = ROOT / "docs" / "make_picture.py"
        namespace = runpy.run_path(str(script))
        path = namespace["main"](["--size", "72", "--output", str(tmp_path / "new" / "camera.png")])
        assert read_image(path).shape == read_image(namespace["PICTURE"]).shape
        assert namespace["PICTURE"].stat().st_size < 300_000

    @pytest.mark.takes_seconds
    def test_feature_the_animation_of_the_documentation_is_drawn(self, tmp_path):
        namespace = runpy.run_path(str(ROOT / "docs" / "make_animation.py"))
        path = namespace["main"](["--size", "72", "--output", str(tmp_path / "new" / "exposure.webp")])
        with Image.open(path) as drawn, Image.open(namespace["PICTURE"]) as shipped:
            assert drawn.n_frames > 30
            assert (drawn.size, drawn.n_frames) == (shipped.size, shipped.n_frames)
        assert namespace["PICTURE"].stat().st_size < 300_000

    @pytest.mark.parametrize("name", [n for n in NAMES if n.startswith("docs/") and "/record/" not in n])
    def test_feature_a_page_begins_with_its_use(self, name):
        """Lists of pages begin with what they list."""
        opening = (ROOT / name).read_text(encoding="utf-8").split("\n\n")[1].replace("\n", " ")
        lists = ("This page lists", "Each guide takes you")
        assert opening.startswith(("After this page you ", *lists)), opening

    def test_feature_the_readme_is_short(self):
        assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 200

    def test_feature_the_readme_links_every_page(self):
        """By way of the list of all pages; the guides and the libraries have lists of theirs."""
        links = {file for file, _ in LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))}
        assert "docs/README.md" in links
        listed = {file for file, _ in LINK.findall((ROOT / "docs" / "README.md").read_text(encoding="utf-8"))}
        docs = ROOT / "docs"
        pages = {path.relative_to(docs).as_posix() for path in [*docs.glob("*.md"), *docs.glob("record/*.md")]}
        assert pages - {"README.md"} <= listed
        for name in ("guides", "ecosystems"):
            listed = {file for file, _ in LINK.findall((docs / f"{name}.md").read_text(encoding="utf-8"))}
            assert {path.relative_to(docs).as_posix() for path in docs.glob(f"{name}/*.md")} <= listed

    @pytest.mark.parametrize("name", NAMES)
    def test_feature_the_site_lists_every_page_once(self, name):
        """Sphinx takes a page that no list of contents names for an error, but only once the whole site is built."""
        lines = (ROOT / "docs" / "site" / "index.rst").read_text(encoding="utf-8").splitlines()
        listed = [re.sub(r".*<(.+)>", r"\1", line.strip()) for line in lines if line.startswith("   ")]
        assert listed.count(name.removesuffix(".md")) == 1


def page(*parts: str) -> str:
    return "\n".join(parts) + "\n"
