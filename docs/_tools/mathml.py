# SPDX-License-Identifier: Apache-2.0
"""Formulas as MathML, made by docutils at build time, so that a page needs neither scripts nor the network."""

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.errors import SphinxError
from sphinx.writers.html5 import HTML5Translator


def mathml(node: nodes.math | nodes.math_block, block: bool) -> str:
    """Return a formula as MathML; SphinxError when it cannot be read, so that the build stops."""
    try:
        return str(latex2mathml.tex2mathml(node.astext(), as_block=block))
    except Exception as error:
        raise SphinxError(f"the formula {node.astext()!r} cannot be converted: {error}") from error


def visit_inline(writer: HTML5Translator, node: nodes.math) -> None:
    """Write a formula within a line."""
    writer.body.append(mathml(node, False))
    raise nodes.SkipNode


def visit_block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula on a line of its own."""
    writer.body.append(writer.starttag(node, "div", CLASS="math"))
    writer.body.append(mathml(node, True) + "</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
