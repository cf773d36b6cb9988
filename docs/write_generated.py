"""Write the generated parts of the pages: `python docs/write_generated.py`; `make docs` runs it first.

Tables of keys, help texts, docstrings of the environments, the gallery and the table of policies come from
the schemas, commands and records themselves. A test fails when a page is stale.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from extensions.commands import command_pages  # noqa: E402 - the path comes first
from extensions.gallery import gallery  # noqa: E402
from extensions.keys import key_tables  # noqa: E402
from extensions.policies import policy_table  # noqa: E402

from agents import configuration  # noqa: E402
from agents.configuration.gradients import GradientConfiguration  # noqa: E402
from agents.configuration.residual import ResidualConfiguration  # noqa: E402
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmGoalEnv, Scene  # noqa: E402
from dq_space_arm_env.scene import Cylinder, Pose, Shape  # noqa: E402
from dq_space_arm_env.scene.maneuver import Success  # noqa: E402

BLOCK = re.compile(
    r"(?<=^<!-- generated: )([\w-]+)( -->\n).*?(?=^<!-- end of generated text -->$)", re.M | re.S
)


def docstring_page(environment: type) -> str:
    """Return an environment's class docstring, which is written as a page, one heading level down."""
    text = re.sub(r"^## ", "### ", inspect.getdoc(environment) or "", flags=re.MULTILINE)
    return text.replace("\n\n```\n", "\n```\n")  # doctests need the empty line, the page does not


_PLACES = {  # of parts that stand in several places of a scene
    Pose: "Poses",
    Shape: "`geometry[]` of `base`, `links[]`, `payload` and `target`",
    Cylinder: "`geometry[].cylinder`",
    Success: "`success`, and `phases[].catch`",
}

TEXTS: Mapping[str, Callable[[], str]] = {
    "scene-keys": lambda: re.sub("^###", "##", key_tables(Scene, _PLACES), flags=re.M),  # a whole page
    "reinforcement-keys": partial(key_tables, configuration.Configuration),
    "imitation-keys": partial(key_tables, configuration.ImitationConfiguration),
    "gradient-keys": partial(key_tables, GradientConfiguration),
    "residual-keys": partial(key_tables, ResidualConfiguration),
    "environment": partial(docstring_page, DQSpaceArmEnv),
    "goal-environment": partial(docstring_page, DQSpaceArmGoalEnv),
    "commands": command_pages,
    "gallery": gallery,
    "zoo": policy_table,
}


def fill(page: str) -> str:
    """Return a page's Markdown with its generated parts up to date; KeyError for an unknown part."""
    return BLOCK.sub(lambda block: f"{block[1]}{block[2]}\n{TEXTS[block[1]]().strip()}\n\n", page)


def main() -> int:
    """Bring all pages up to date and name those that change; with --check, only name them and return 1."""
    check, stale = "--check" in sys.argv[1:], 0
    for path in sorted(DOCS.glob("*.md")):
        old = path.read_text(encoding="utf-8")
        if (new := fill(old)) != old:
            stale = 1
            print(f"{path.relative_to(DOCS.parent)} {'is stale' if check else 'is up to date now'}")
            if not check:
                path.write_text(new, encoding="utf-8")
    return stale if check else 0


if __name__ == "__main__":
    sys.exit(main())
