"""Settings of Sphinx for the documentation; `make docs` builds it (docs/building)."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from pygments.lexers.special import TextLexer

project = "cqrun"
author = copyright = "The cqrun authors"
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "cqrun"
html_static_path = ["_static"]
html_css_files = ["cqrun.css"]
html_js_files = ["copy.js"]
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
nitpicky = True
pygments_style = "friendly"
pygments_dark_style = "native"


def math(translator: Any, node: nodes.Element) -> None:
    """Write an equation as MathML, which browsers show without a script or a font of the web."""
    display = isinstance(node, nodes.math_block)
    mathml = str(tex2mathml(node.astext(), as_block=display))
    translator.body.append(f'<div class="equation">{mathml}</div>' if display else mathml)
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Register the writer of equations, and names of blocks."""
    app.add_html_math_renderer("mathml", (math, None), (math, None))
    for name in ("csv", "tsv"):
        app.add_lexer(name, TextLexer)
