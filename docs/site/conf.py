"""Settings of Sphinx for the site that `make docs` builds. All warnings are errors, and every reference is checked."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

SITE = Path(__file__).resolve().parent
sys.path[:0] = [str(SITE), str(SITE.parents[1])]

import references  # noqa: E402

import kornia_tidy  # noqa: E402

project = "kornia_tidy"
author = "The kornia_tidy authors"
project_copyright = author
release = version = kornia_tidy.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
nitpicky = True
_SETTINGS = "Metres|Distance|DepthRange|Seed|Preset|Compositing|Border|StrayLight|ColorSpace|Start|Inverse"
# Other names of float, int and str, with the units, ranges and choices of settings.
nitpick_ignore_regex = [("py:class", _SETTINGS), ("py:obj", r"typing\.Annotated.*")]
default_role = "literal"  # docstrings write commands as Markdown does
exclude_patterns = ["examples/*.md"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4  # links to headings as GitHub makes them
myst_fence_as_directive = ["mermaid"]

autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "groupwise"}
autodoc_mock_imports = ["torchvision", "albumentations", "deepinv"]  # the adapters are described without them
autodoc_inherit_docstrings = False
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Shape", "Convention", "Source", "Assumes"]
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "kornia_tidy"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_theme_options = {
    "navigation_with_keys": True,
    "top_of_page_buttons": [],  # pages of the gallery and the reference are generated and have no source to edit
}
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
linkcheck_anchors = False  # pages of GitHub make theirs in the browser
linkcheck_timeout = 20

BACK = re.compile(r'(<a class="viewcode-back" href="[^"#]*#)([^"]*)(">.*?</a>)')  # from a source to its description
EXAMPLE = re.compile(r"\(((?:\.\./)*)examples/(\w+)\.py\)")


def link_examples_to_the_gallery(_app: object, _name: str, source: list[str]) -> None:
    """Let links to an example's file, which GitHub shows, lead to its page in the gallery."""
    source[0] = EXAMPLE.sub(r"(\1gallery/\2.md)", source[0])


def keep_sentences_of_properties(
    _app: object, what: str, _name: str, _obj: object, _options: object, lines: list
) -> None:
    """Keep Napoleon from reading "Height in metres: the ..." of a property as a type and a description."""
    if what in {"attribute", "data", "property"}:
        lines.insert(0, "\\")  # an escaped end of line: nothing in the page


def shorten_factories(
    _app: object, _what: str, _name: str, _obj: object, _options: object, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Write a default that a dataclass makes anew as an ellipsis: Sphinx cannot parse "<factory>"."""
    return signature and signature.replace("<factory>", "..."), returned


def drop_modules_without_source(_app: object, env: Any) -> None:
    """Drop pages of modules without source."""
    for module, entry in list(getattr(env, "_viewcode_modules", {}).items()):
        if not entry:
            del env._viewcode_modules[module]


def mend_links_of_sources(app: Any, page: str, _template: str, context: dict[str, Any], _doctree: object) -> None:
    """Let links of sources lead to descriptions under their own package: viewcode takes one for a whole module."""
    entry = getattr(app.env, "_viewcode_modules", {}).get(page.removeprefix("_modules/").replace("/", "."))
    if entry is None:
        return
    _, _, used, package = entry
    described = {name: home for name, _, _, home, anchor, _ in app.env.get_domain("py").get_objects() if name == anchor}

    def mended(link: re.Match[str]) -> str:
        name = link[2].removeprefix(f"{package}.")
        ours = [full for full, home in described.items() if home == used[name] and full.endswith(f".{name}")]
        return f"{link[1]}{ours[0]}{link[3]}" if ours else ""

    context["body"] = BACK.sub(mended, context["body"])


def setup(app: Any) -> None:
    """Register the functions of this file with Sphinx."""
    import drawn_in_page  # noqa: PLC0415

    app.connect("source-read", link_examples_to_the_gallery)
    app.connect("autodoc-process-docstring", keep_sentences_of_properties, priority=400)
    app.connect("autodoc-process-signature", shorten_factories)
    app.connect("missing-reference", references.resolve)
    app.connect("env-check-consistency", drop_modules_without_source)
    app.connect("html-page-context", mend_links_of_sources)
    app.add_directive("mermaid", drawn_in_page.FlowChart)
    app.add_html_math_renderer("mathml", (drawn_in_page.visit_inline, None), (drawn_in_page.visit_block, None))
