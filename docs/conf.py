"""How Sphinx builds the documentation: `make docs`."""

import re
import sys
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike
from sphinx.util.typing import stringify_annotation

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "docs"), str(ROOT)]

from dq_space_arm_env import __version__  # noqa: E402 - the path comes first

project = "DQ Space Arm"
author = "the authors of DQ Space Arm"
copyright = author
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "extensions.formulas",
]
exclude_patterns = ["extensions"]
myst_enable_extensions = ["amsmath", "deflist", "dollarmath"]
myst_heading_anchors = 3
html_math_renderer = "mathml"
math_numfig = False

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
# Names of other projects: without a network nobody knows where they are described.
nitpick_ignore_regex = [("py:.*", r".*")]
# The extra `agents` describes itself by its signatures; its libraries need not be there.
autodoc_mock_imports = ["sb3_contrib", "stable_baselines3", "torch"]
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
pygments_dark_style = "monokai"
html_title = f"DQ Space Arm {version}"
html_static_path = ["style"]
html_css_files = ["pages.css"]
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False
html_theme_options: dict[str, Any] = {
    "light_css_variables": {"color-brand-primary": "#1f5fa8", "color-brand-content": "#1f5fa8"},
    "dark_css_variables": {"color-brand-primary": "#7fb2ee", "color-brand-content": "#7fb2ee"},
}
_ARRAY_LIKE = stringify_annotation(ArrayLike, "smart")
_ARRAY = re.compile(r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[(.+?)\]\]")
_UNSPEAKABLE = re.compile(r"<.+?>+(?=[,)])")
"""A default that is a function, or made anew each time."""
# What environments say of themselves is a page; autodoc need not repeat it.
_PAGES = {"DQSpaceArmEnv": "environment", "DQSpaceArmGoalEnv": "environment"}


def _shorten(app: Any, what: str, name: str, member: object, options: Any, lines: list[str]) -> None:
    if what == "class" and name.rpartition(".")[2] in _PAGES:
        lines[:] = ["See :doc:`environment`."]
    lines[:] = [_escaped(line) for line in lines]


def _name_types(
    app: Any, what: str, name: str, member: object, options: Any, arguments: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return _named(arguments), _named(returns)


def _named(signature: str | None) -> str | None:
    """A signature with the names of types in place of what Python makes of them."""
    if signature is None:
        return None
    short = signature.replace(_ARRAY_LIKE, "~numpy.typing.ArrayLike")
    return _UNSPEAKABLE.sub("...", _ARRAY.sub(r"~numpy.typing.NDArray[\1]", short))


def _escaped(line: str) -> str:
    """A docstring's line: plain text with code in backticks. |x| and `x`s mean something else to Sphinx."""
    plain, *others = re.split(r"(`[^`]+`)", line)
    text = plain.replace("|", "\\|")
    for code, after in zip(others[::2], others[1::2], strict=True):
        text += code + re.sub(r"^(?=\w)", r"\\ ", after).replace("|", "\\|")
    return text


def setup(app: Any) -> None:
    """Connect what is special to these pages.

    Args:
        app: Sphinx.
    """
    app.connect("autodoc-process-docstring", _shorten)
    app.connect("autodoc-process-signature", _name_types)
