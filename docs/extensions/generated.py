"""Puts what is generated into pages: a line `<!-- generated: name -->` becomes the text of that name.

The texts are Markdown, made when a page is read, from the schemas, docstrings, commands and records that the
program uses itself: they cannot be out of date.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping

from pydantic import BaseModel
from sphinx.application import Sphinx

from agents import configuration
from agents.configuration.residual import ResidualConfiguration
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmGoalEnv, Scene
from extensions.commands import command_pages
from extensions.keys import key_tables
from extensions.policies import policy_table

MARK = re.compile(r"^<!-- generated: ([\w-]+) -->$", flags=re.MULTILINE)


def _docstring(kind: type) -> Callable[[], str]:
    """The docstring of an environment, which is its documentation page."""

    def text() -> str:
        found = re.sub(r"^## ", "### ", inspect.getdoc(kind) or "", flags=re.MULTILINE)
        return found.replace("\n\n```\n", "\n```\n")  # doctests need the empty line

    return text


def _keys(model: type[BaseModel]) -> Callable[[], str]:
    return lambda: key_tables(model)


TEXTS: Mapping[str, Callable[[], str]] = {
    "scene-keys": _keys(Scene),
    "reinforcement-keys": _keys(configuration.Configuration),
    "imitation-keys": _keys(configuration.ImitationConfiguration),
    "residual-keys": _keys(ResidualConfiguration),
    "environment": _docstring(DQSpaceArmEnv),
    "goal-environment": _docstring(DQSpaceArmGoalEnv),
    "commands": command_pages,
    "zoo": policy_table,
}
"""What can be asked for, by name."""


def fill(page: str) -> str:
    """Replace the marks of a page.

    Args:
        page: Markdown.

    Returns:
        The page with what they stand for.

    Raises:
        KeyError: If a mark asks for what is not there.
    """
    return MARK.sub(lambda mark: TEXTS[mark[1]]().rstrip(), page)


def _on_read(app: Sphinx, name: str, source: list[str]) -> None:
    source[0] = fill(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Fill pages as they are read.

    Args:
        app: Sphinx.

    Returns:
        That pages may be read and written in parallel.
    """
    app.connect("source-read", _on_read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
