from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tests.base import BaseTester

ROOT = Path(__file__).resolve().parents[3]


class TestCommand(BaseTester):
    @pytest.mark.parametrize("text", ["0", "80", "65536", "x", "-1", "8080.5", "9" * 400])
    def test_exception_ports(self, text, refused):
        assert "--port must be a whole number from 1024 to 65535, got" in refused(["app", f"--port={text}"])

    @pytest.mark.skipif(importlib.util.find_spec("gradio") is not None, reason="Gradio is installed")
    def test_exception_without_gradio_the_remedy_is_told(self, refused):
        pytest.importorskip("matplotlib")
        assert "the app needs gradio: pip install 'kornia-tidy[app]'" in refused(["app"])


class TestConstraints(BaseTester):
    """Gradio 6.31 needs a Pillow below 13, which constraints.txt has."""

    def pins(self, name):
        lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
        return dict(re.fullmatch(r"([\w.-]+)==(\S+)", line).groups() for line in lines if line and line[0] != "#")

    def test_feature_those_of_the_app_differ_in_pillow_alone(self):
        usual, app = self.pins("constraints.txt"), self.pins("constraints-app.txt")
        assert {"gradio", "torch", "kornia", "matplotlib"} <= set(app)
        assert {name for name in usual if usual[name] != app.get(name, usual[name])} == {"pillow"}
