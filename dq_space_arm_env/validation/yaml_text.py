"""YAML 1.2 by ruamel.yaml: `1e-3` is a number, `no` is text, a key may stand in a mapping only once."""

import warnings
from collections.abc import Sequence
from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter
from ruamel.yaml.resolver import VersionedResolver

__all__ = ["YAMLError", "dump_yaml", "line_of", "parse_yaml", "yaml_problem"]

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
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if is_text else "'")

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


def parse_yaml(text: str) -> Any:
    """Read one YAML document as plain data; None if it is empty.

    Raises:
        YAMLError: If it is not YAML, or a key or an anchor stands twice; see `yaml_problem`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", ReusedAnchorWarning)
        try:
            return _yaml().load(text)
        except ReusedAnchorWarning as error:
            raise YAMLError(" ".join(str(error).split())) from None


def dump_yaml(data: dict[str, Any], header: str = _HEADER) -> str:
    """Write plain data as YAML below a comment, lists of numbers on one line; `parse_yaml` reads it back."""
    yaml = _yaml()
    yaml.Representer = _Representer
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
        return f"line {mark.line + 1}, column {mark.column + 1}: {said}"
    return str(error)


def line_of(text: str, location: Sequence[str | int]) -> int:
    """Find the line of a key, or of the nearest one around it that the text has."""
    node: Node = _yaml().compose(text)
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


def _yaml() -> YAML:
    return YAML(typ="safe", pure=True, plug_ins=[])
