"""YAML as a scene needs it: numbers as everyone writes them, no duplicate keys, lists of numbers on one line.

PyYAML follows YAML 1.1, where `1e-3` is text, `1:30` is ninety and `no` is false. Here numbers and truth
values are written as in YAML 1.2.
"""

import re
from collections.abc import Hashable
from typing import Any

import yaml

_HEADER = (
    "# SI units (m, kg, s, N, N m, rad); quaternions are scalar first; poses are position and rotation.\n"
)


class _Loader(yaml.SafeLoader):
    """Safe loader with YAML 1.2 numbers that refuses duplicate keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue  # PyYAML refuses it as unhashable
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"duplicate key {key_node.value!r}", problem_mark=key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


_REPLACED = ("tag:yaml.org,2002:bool", "tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _REPLACED]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|false)$"), list("tf"))
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789")
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan)$"),
    list("-+.0123456789"),
)


class _Dumper(yaml.SafeDumper):
    """Safe dumper that never uses anchors, and writes tuples as lists."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(tuple, lambda dumper, items: dumper.represent_list(items))
_Dumper.add_representer(
    dict, lambda dumper, items: dumper.represent_mapping("tag:yaml.org,2002:map", items, flow_style=False)
)
# The dumper keeps YAML 1.1's words too: text that either version would read as something else is quoted.
for _first, _resolvers in _Loader.yaml_implicit_resolvers.items():
    for _tag, _pattern in _resolvers:
        _Dumper.add_implicit_resolver(_tag, _pattern, [_first])


def parse_yaml(text: str) -> Any:
    """Read YAML text.

    Args:
        text: The content of one YAML file.

    Returns:
        Plain data: dicts, lists, text, numbers, booleans; None for an empty file.

    Raises:
        yaml.YAMLError: If it is not YAML, or if a key stands twice in one mapping; it knows line and column.
    """
    return yaml.load(text, Loader=_Loader)


def dump_yaml(data: dict[str, Any], header: str = _HEADER) -> str:
    """Write plain data as YAML, lists of numbers on one line.

    Args:
        data: Dicts, lists, tuples, text, numbers, booleans.
        header: Comment lines to begin with; on the units by default.

    Returns:
        The YAML text with its comment; `parse_yaml` gives the data back, tuples as lists.
    """
    # default_flow_style=None: only lists without lists inside go on one line.
    return header + yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)
