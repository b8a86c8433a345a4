"""Formulas as MathML and flow charts as SVG, parts of a page that browsers draw themselves: nothing is loaded."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from flowchart import draw_chart
from latex2mathml.converter import convert


def formula(latex: str, display: str) -> str:
    r"""Return a formula as MathML; rows (``\\``) and columns (``&``) are aligned."""
    latex = latex.replace(r"\arg", r"\mathrm{arg}")  # a command that the converter does not know
    if r"\begin" not in latex and (r"\\" in latex or "&" in latex):
        latex = rf"\begin{{split}}{latex}\end{{split}}"  # aligned is written without its rows
    written = convert(latex, display=display)
    if unknown := re.findall(r">\s*(\\\w+)", written):
        raise ValueError(f"{unknown[0]} cannot be written as MathML, in {latex}")
    return written


def visit_inline(writer: Any, node: nodes.math) -> None:
    """Write a formula in a line."""
    writer.body.append(formula(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(writer: Any, node: nodes.math_block) -> None:
    """Write a displayed formula."""
    writer.body.append(f'<div class="formula">{formula(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


class FlowChart(Directive):
    """A flow chart in a page."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the drawing."""
        try:
            return [nodes.raw("", draw_chart("\n".join(self.content)), format="html")]
        except ValueError as error:
            raise self.error(str(error)) from error
