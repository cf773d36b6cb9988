"""YAML 1.2 by ruamel.yaml: `1e-3` is a number, `no` is text, a key may stand in a mapping only once.

Length, depth and what aliases expand to are limited while the text is read, before anything is built of it.
"""

import os
import warnings
from collections.abc import Sequence
from functools import lru_cache
from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.constructor import ConstructorError, SafeConstructor
from ruamel.yaml.emitter import Emitter
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.events import AliasEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter
from ruamel.yaml.resolver import VersionedResolver
from ruamel.yaml.scanner import Scanner, ScannerError

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_text
from dq_space_arm_env.common.shown_text import printable, shortened

__all__ = ["YAMLError", "dump_yaml", "line_of", "parse_yaml", "read_yaml", "yaml_problem"]

TEXT_LENGTH = 2**16
"""Largest length of a text: 25 times the longest file that ships, parsed in a second."""
DEPTH = 32
"""Largest depth: a scene has 6 levels."""
NODES = 5_000
"""Largest number of keys and values, aliases written out: a link of a scene has some forty."""
_DIGITS = 300  # of an integer; with more it has no float
_LONGEST_PROBLEM = 300  # characters
_FOLDED = ("\x85", "  ")  # come back as one space where they end a line, but for between double quotes

_HEADER = (
    "# SI units (m, kg, s, N, N m, rad); quaternions are scalar first; poses are position and rotation.\n"
)


class _Representer(SafeRepresenter):
    """Writes tuples as lists, mappings in blocks, no anchors, and quotes what YAML 1.1 reads as no text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_text(self, data: str) -> ScalarNode:
        is_text = all(
            resolver.resolve(ScalarNode, data, (True, False)) == "tag:yaml.org,2002:str"
            for resolver in (VersionedResolver((1, 1)), VersionedResolver((1, 2)))
        )
        style = None if is_text else "'"
        if any(each in data for each in _FOLDED):
            style = '"'
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=style)

    def represent_number(self, data: float) -> ScalarNode:
        node = self.represent_float(data)
        if "e" in node.value and "." not in node.value:
            node.value = node.value.replace("e", ".0e")  # 1e-05 is text in YAML 1.1
        return node


_Representer.add_representer(tuple, _Representer.represent_list)
_Representer.add_representer(str, _Representer.represent_text)
_Representer.add_representer(float, _Representer.represent_number)
_Representer.add_representer(
    dict, lambda self, data: self.represent_mapping("tag:yaml.org,2002:map", data, flow_style=False)
)


class _Emitter(Emitter):
    """Keeps text between double quotes on one line: where it folds behind a tab, a space more comes back."""

    def write_double_quoted(self, text: Any, split: Any = True) -> None:
        super().write_double_quoted(text, split=False)


class _Scanner(Scanner):
    """Refuses brackets nested too deep, which it would otherwise look ahead through."""

    def fetch_flow_collection_start(self, TokenClass: Any, to_push: str) -> None:
        if len(self.flow_context) >= DEPTH:
            raise ScannerError(None, None, f"nested deeper than {DEPTH} levels", self.reader.get_mark())
        super().fetch_flow_collection_start(TokenClass, to_push)


class _Composer(Composer):
    """Refuses what is nested too deep, or too large once its aliases are written out."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self._level, self._nodes = 0, 0
        self._sizes: dict[Any, int] = {}  # of the nodes that aliases may stand for

    def compose_node(self, parent: Any, index: Any) -> Any:
        event, before = self.parser.peek_event(), self._nodes
        self._level += 1
        if self._level > DEPTH:
            raise ComposerError(None, None, f"nested deeper than {DEPTH} levels", event.start_mark)
        node = super().compose_node(parent, index)
        self._level -= 1
        if not isinstance(event, AliasEvent):
            self._nodes += 1
            self._sizes[node] = self._nodes - before
        elif node in self._sizes:
            self._nodes += self._sizes[node]
        else:
            raise ComposerError(
                None, None, f"alias *{event.anchor} stands inside what it stands for", event.start_mark
            )
        if self._nodes > NODES:
            raise ComposerError(
                None, None, f"more than {NODES:,} keys and values, aliases written out", event.start_mark
            )
        return node


class _Constructor(SafeConstructor):
    """Gives the places of equal keys, and of texts that are no value of their kind: the 45th of a month."""

    def check_mapping_key(self, node: Any, key_node: Any, mapping: Any, key: Any, value: Any) -> bool:
        if key not in mapping:
            return True
        first = next(each for each, _ in node.value if self.construct_object(each, deep=True) == key)
        lines = f"lines {first.start_mark.line + 1} and {key_node.start_mark.line + 1}"
        said = f"the key {shortened(key, 40)} stands twice, in {lines}: keep one"
        raise ConstructorError(None, None, said, key_node.start_mark)

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        text = node.value if isinstance(node, ScalarNode) else ""
        kind = str(node.tag).rpartition(":")[2]
        if kind == "int" and len(text) > _DIGITS:
            raise ConstructorError(
                None,
                None,
                f"an integer of {len(text):,} digits, at most {_DIGITS} are possible",
                node.start_mark,
            )
        try:
            return super().construct_object(node, deep)
        except (YAMLError, RecursionError):
            raise
        except Exception as error:  # the converters raise anything
            said = f"{shortened(text, 40)} is not of the kind {shortened(kind, 40)}"
            raise ConstructorError(None, None, f"{said}; quote it if it is text", node.start_mark) from error


def parse_yaml(text: str) -> Any:
    """Read one YAML document as plain data; None if it is empty.

    Raises:
        YAMLError: If it is not YAML, too large or too deep, or a key or an anchor stands twice; see
            `yaml_problem`.
    """
    if len(text) > TEXT_LENGTH:
        raise YAMLError(f"the text has {len(text):,} characters, it should have at most {TEXT_LENGTH:,}")
    with warnings.catch_warnings():
        warnings.simplefilter("error", ReusedAnchorWarning)
        try:
            return _yaml().load(text)
        except ReusedAnchorWarning as error:
            raise YAMLError(" ".join(str(error).split())) from None


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Read a file of YAML, see `parse_yaml`.

    Raises:
        UnreadableError: If it is no regular text file in UTF-8, or larger than such a text may be.
        YAMLError: As `parse_yaml`.
    """
    return parse_yaml(read_text(path, 4 * TEXT_LENGTH))  # a character takes up to 4 bytes


def mapping_at_top(path: object, data: Any) -> dict[str, Any]:
    """The content of a file of YAML that has keys; UnreadableError, with its path, for any other."""
    if not isinstance(data, dict):
        raise UnreadableError(f"{path}: must be a mapping (key: value) at the top")
    return data


def dump_yaml(data: dict[str, Any], header: str = _HEADER) -> str:
    """Write plain data as YAML below a comment, lists of numbers on one line; `parse_yaml` reads it back."""
    yaml = _yaml()
    yaml.Representer, yaml.Emitter = _Representer, _Emitter
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.default_flow_style = None  # lists of numbers on one line, nothing else
    yaml.width = 120
    stream = StringIO()
    yaml.dump(data, stream)
    return header + stream.getvalue()


def yaml_problem(error: YAMLError) -> str:
    """Describe an error of `parse_yaml` in one sentence, with line and column."""
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        said = ", ".join(part for part in (error.context, error.problem) if part)
        return f"line {mark.line + 1}, column {mark.column + 1}: {printable(said[:_LONGEST_PROBLEM])}"
    return printable(" ".join(str(error).split())[:_LONGEST_PROBLEM])


def line_of(text: str, location: Sequence[str | int]) -> int:
    """Find the line of a key, or of the nearest one around it that the text has."""
    node = _composed(text)
    line = node.start_mark.line
    for part in location:
        if isinstance(node, MappingNode):
            entry = next((pair for pair in node.value if pair[0].value == part), None)
            if entry is None:
                break
            line, node = entry[0].start_mark.line, entry[1]
        elif isinstance(node, SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line
        else:
            break
    return int(line) + 1


@lru_cache(maxsize=1)  # the problems of one file come together
def _composed(text: str) -> Node:
    node: Node = _yaml().compose(text)
    return node


def _yaml() -> YAML:
    yaml = YAML(typ="safe", pure=True, plug_ins=[])
    yaml.Scanner, yaml.Composer, yaml.Constructor = _Scanner, _Composer, _Constructor
    return yaml
