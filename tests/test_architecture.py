"""The picture of the packages in docs/architecture.md, drawn from small packages made here."""

from __future__ import annotations

import doctest
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from tests.base import BaseTester

ROOT = Path(__file__).resolve().parents[1]

LAYERS = """
[importlinter:contract:layers]
layers =
    (__main__)
    commands : (app)
    camera
    optics
    seeds
"""
MARKERS = "<!-- made: diagram --><!-- end: diagram -->\n<!-- made: packages --><!-- end: packages -->\n"
FILES = {
    "__init__.py": "from kornia_tidy.camera.whole import Camera",
    "__main__.py": "import kornia_tidy.commands.show",
    "seeds.py": '"""Seeds. And more."""',
    "commands/__init__.py": '"""What a shell\ncalls."""',
    "commands/show.py": "from kornia_tidy.camera.whole import Camera\ndef show():\n    import kornia_tidy.optics.lens",
    "camera/__init__.py": '"""The :class:`~kornia_tidy.Camera`, in ``whole.py``."""',
    "camera/whole.py": "from kornia_tidy.optics.lens import Lens\nfrom kornia_tidy.seeds import seed",
    "optics/__init__.py": '"""Light."""',
    "optics/lens.py": "import torch",
}


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_architecture", ROOT / "docs" / "make_architecture.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def checkout(tmp_path):
    """A small package with its documents."""
    for name, text in FILES.items():
        path = tmp_path / "kornia_tidy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / ".importlinter").write_text(LAYERS)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "architecture.md").write_text(f"Before.\n{MARKERS}After.\n")
    return tmp_path


class TestMakeArchitecture(BaseTester):
    def test_smoke_doctests(self, script):
        assert doctest.testmod(script).failed == 0

    def test_feature_an_import_against_the_order_is_dotted(self, script, checkout):
        (checkout / "kornia_tidy/optics/lens.py").write_text("if TYPE_CHECKING:\n    import kornia_tidy.camera.whole")
        script.main([], checkout)
        text = (checkout / "docs" / "architecture.md").read_text()
        assert "optics -. against the order .-> camera" in text

    def test_feature_check_writes_nothing_and_tells_what_is_stale(self, script, checkout, capsys):
        before = (checkout / "docs" / "architecture.md").read_text()
        assert script.main(["--check"], checkout) == 1
        assert "docs/architecture.md is stale" in capsys.readouterr().err
        assert (checkout / "docs" / "architecture.md").read_text() == before
        script.main([], checkout)
        assert script.main(["--check"], checkout) == 0
        assert capsys.readouterr().err == ""

    def test_feature_files_that_are_not_there_are_named(self, script, checkout, capsys):
        text = (
            "`camera/whole.py` `camera/gone.py` `camera/<name>.py` `kornia_tidy/optics/` [x](docs/architecture.md#a) "
            "[y](gone.md) [z](https://example.org/gone.md)\n```\n`camera/in_a_block.py`\n```\n"
        )
        for page in ("CONTRIBUTING.md", "docs/page.md"):
            (checkout / page).write_text(text.replace("docs/", "") if page == "docs/page.md" else text)
        assert script.main([], checkout) == 1
        said = capsys.readouterr().err.splitlines()
        assert said == [
            f"{page} names {name}, which is not there"
            for page in ("CONTRIBUTING.md", "docs/page.md")
            for name in ("camera/gone.py", "gone.md")
        ]
