"""Formulas as MathML, which browsers show by themselves: no script, no font and no request to anybody.

Docutils translates the LaTeX; what it does not know is an error of the build.
"""

import re
from html import unescape
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_LOG = logging.getLogger(__name__)
_MATHML = "http://www.w3.org/1998/Math/MathML"
ElementTree.register_namespace("", _MATHML)


def _mathml(node: nodes.Node, *, block: bool) -> str:
    source = node.astext()
    try:
        return _with_accents(tex2mathml(source, as_block=block))
    except MathError as error:
        _LOG.warning("formula cannot be read: %s: %s", source, error, location=node)
        return f"<code>{source}</code>"


def _with_accents(mathml: str) -> str:
    """Give letters with an accent and an index the index beside them: docutils writes it below."""
    # Names of characters that HTML knows and XML does not.
    tree = ElementTree.fromstring(re.sub(r"&(?!amp;|lt;|gt;)\w+;", lambda name: unescape(name[0]), mathml))
    for element in tree.iter(f"{{{_MATHML}}}munderover"):
        base, index, accent = element
        if accent.get("stretchy") == "false" and base.tag.endswith("}mi"):
            element.tag = f"{{{_MATHML}}}msub"
            over = ElementTree.Element(f"{{{_MATHML}}}mover", accent="true")
            over.extend((base, accent))
            element[:] = [over, index]
    return ElementTree.tostring(tree, encoding="unicode")


def _visit_inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node, block=False))
    raise nodes.SkipNode


def _visit_block(writer: Any, node: nodes.math_block) -> None:
    number = node["number"]
    anchor = f' id="{node["ids"][0]}"' if node.get("ids") else ""
    shown = f'<span class="eqno">({number})</span>' if number else ""
    writer.body.append(f'<div class="math"{anchor}>{shown}{_mathml(node, block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer `mathml`.

    Args:
        app: Sphinx.

    Returns:
        That pages may be read and written in parallel.
    """
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
