"""Choose the mutants of `mutants.jsonl`; a tool, not a test. Needs Cosmic Ray, which supplies the operators.

    python tests/reliability/mutant_selection.py HEART ... >> tests/reliability/mutants.jsonl

A mutant is a line of a function and what it becomes, so it survives when lines move. Candidates are the
positions of Cosmic Ray's operators, and dropped statements; left out are annotations, docstrings, error
messages, assertions, decorators, prefetching and clocks, and constants of modules other than tableaus.
Comparisons of floats are reversed, never moved by their boundary: no run would tell `<` from `<=`.
"""

import ast
import json
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parents[2]
SEED = 17

# Number of mutants and files of each heart, about in proportion to their candidates.
HEARTS = {
    "dynamics": (58, "dq_space_arm_env/dynamics/*.py"),
    "algebra": (42, "dq_space_arm_env/algebra/*.py"),
    "task": (24, "dq_space_arm_env/task/*.py"),
    "environment": (42, "dq_space_arm_env/environment/*.py"),
    "integrators": (48, "dq_space_arm_env/integrators/*.py"),
    "solver": (52, "experts/ddp/*.py"),
    "receding_horizon": (10, "experts/receding_horizon.py"),
    "files": (8, "dq_space_arm_env/common/files.py"),
    "resume": (16, "experts/demonstrations/folder.py agents/run_folder.py"),
}

_ARITHMETIC = "Add_Sub Sub_Add Mul_Div Mul_Add Div_Mul Pow_Mul FloorDiv_Mul Mod_Mul BitAnd_BitOr BitOr_BitAnd"
_REVERSED = "Lt_Gt Gt_Lt LtE_Gt GtE_Lt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
_BOUNDARY = "Lt_LtE Gt_GtE LtE_Lt GtE_Gt"
_OTHERS = (
    "ReplaceUnaryOperator_USub_UAdd ReplaceUnaryOperator_Delete_Not ReplaceUnaryOperator_Delete_Invert "
    "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd "
    "ReplaceBreakWithContinue ReplaceContinueWithBreak NumberReplacer ZeroIterationForLoop"
)
_OF_INTEGERS = ("environment", "common", "demonstrations", "run_folder", "receding_horizon")
_SKIPPED_CALLS = ("prefetch", "prefetch_to_write", "perf_counter", "progress", "log", "debug", "info", "warn")


def operators(path: Path) -> list[str]:
    comparisons = _REVERSED
    if any(word in path.as_posix() for word in _OF_INTEGERS):
        comparisons += " " + _BOUNDARY
    names = [f"ReplaceBinaryOperator_{name}" for name in _ARITHMETIC.split()]
    names += [f"ReplaceComparisonOperator_{name}" for name in comparisons.split()]
    return [f"core/{name}" for name in (*names, *_OTHERS.split())]


def functions(tree: ast.Module) -> dict[str, ast.AST]:
    """Functions by qualified name; nested ones belong to the outermost. The module's own name is empty."""
    found: dict[str, ast.AST] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef):
                found[prefix + child.name] = child
            elif isinstance(child, ast.ClassDef):
                visit(child, f"{prefix}{child.name}.")

    visit(tree, "")
    return found


def _forbidden(node: ast.AST) -> bool:
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
        return True
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        return name in _SKIPPED_CALLS
    return False


def allowed(function: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a function's body that may be mutated."""
    if _forbidden(function):
        return
    yield function
    skipped = ("annotation", "returns", "decorator_list", "args", "type_params")
    for field, value in ast.iter_fields(function):
        if field in skipped and not (field == "args" and isinstance(function, ast.Call)):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from allowed(child)


def _positions(source: str, names: list[str]) -> Iterator[tuple[str, int, int]]:
    """Operator, occurrence and line of every mutation, in the order of `mutate_code`."""
    nodes = list(ast_nodes(get_ast(source)))
    for name in names:
        operator = get_operator(name)()
        places = [first[0] for node in nodes for first, _ in operator.mutation_positions(node)]
        yield from ((name, occurrence, line) for occurrence, line in enumerate(places))


def _dropped(nodes: list[ast.AST]) -> Iterator[int]:
    """Lines of statements that can be dropped: calls, and assignments to what already exists."""
    for node in nodes:
        whole = getattr(node, "lineno", 0) == getattr(node, "end_lineno", 1)
        is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        is_call = is_call and not _forbidden(node.value)  # type: ignore[attr-defined]
        places = node.targets if isinstance(node, ast.Assign) else []
        assigns = isinstance(node, ast.AugAssign) or any(
            isinstance(place, ast.Subscript) or (isinstance(place, ast.Attribute) and place.attr[0] == "_")
            for place in places
        )
        if whole and (is_call or assigns):
            yield node.lineno


def candidates(path: Path) -> list[dict[str, Any]]:
    source = path.read_text(encoding="utf-8")
    tree, lines = ast.parse(source), source.splitlines()
    scopes: dict[str, ast.AST] = functions(tree)
    if "tableaus" in path.name:
        scopes |= {"": tree}
    owners: dict[int, tuple[str, int]] = {}  # line -> function and the line where it starts
    for name, node in scopes.items():
        first, last = getattr(node, "lineno", 1), getattr(node, "end_lineno", len(lines))
        for child in allowed(node):
            if hasattr(child, "lineno") and child is not node:
                for line in range(child.lineno, (child.end_lineno or child.lineno) + 1):
                    if first < line <= last or not name:
                        owners.setdefault(line, (name, first))
    forbidden = {
        line
        for node in ast.walk(tree)
        if _forbidden(node) or isinstance(node, ast.arguments | ast.AnnAssign) or _is_docstring(node)
        for line in _lines(node)
    }
    dropped = [line for node in scopes.values() for line in _dropped(list(allowed(node)))]
    return [
        {"path": path, "operator": operator, "occurrence": occurrence, "at": line, "owner": owners[line]}
        for operator, occurrence, line in (
            *_positions(source, operators(path)),
            *(("DropStatement", 0, line) for line in dropped),
        )
        if line in owners and line not in forbidden
    ]


def entry_of(candidate: dict[str, Any]) -> dict[str, Any] | None:
    """A mutant as the list has it; None if more than a line changes, or nothing that a run could tell."""
    source = candidate["path"].read_text(encoding="utf-8")
    lines, line, (function, first) = source.splitlines(), candidate["at"], candidate["owner"]
    old, new = lines[line - 1], "pass"
    if candidate["operator"] != "DropStatement":
        operator = get_operator(candidate["operator"])()
        mutated = (mutate_code(source, operator, candidate["occurrence"]) or "").splitlines()
        changed = [i for i, pair in enumerate(zip(lines, mutated, strict=False)) if pair[0] != pair[1]]
        if len(mutated) != len(lines) or changed != [line - 1]:
            return None
        new = mutated[line - 1]
    if "strict=True" in old and "strict=False" in new:  # of zip
        return None
    return {
        "file": candidate["path"].relative_to(ROOT).as_posix(),
        "function": function,
        "operator": candidate["operator"].removeprefix("core/"),
        "line": old.strip(),
        "nth": sum(other.strip() == old.strip() for other in lines[first - 1 : line - 1]),
        "mutant": new.strip(),
        "at": line,
    }


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _lines(node: ast.AST) -> range:
    if isinstance(node, ast.arguments):
        parts = [*node.posonlyargs, *node.args, *node.kwonlyargs]
        return range(parts[0].lineno, max(part.end_lineno or 0 for part in parts) + 1) if parts else range(0)
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)  # type: ignore[attr-defined]


def main(names: list[str]) -> None:
    for heart in names:
        count, patterns = HEARTS[heart]
        paths = [path for pattern in patterns.split() for path in sorted(ROOT.glob(pattern))]
        found = [candidate for path in paths for candidate in candidates(path)]
        random.Random(f"{SEED} {heart}").shuffle(found)
        chosen: list[dict[str, Any]] = []
        taken: set[tuple[Path, int]] = set()
        for candidate in found:
            place = candidate["path"], candidate["at"]
            if len(chosen) < count and place not in taken and (entry := entry_of(candidate)):
                taken.add(place)  # one mutant of a line
                chosen.append(entry)
        print(f"{heart}: {len(chosen)} of {len(found)} candidates", file=sys.stderr)
        for entry in sorted(chosen, key=lambda entry: (entry["file"], entry["at"])):
            del entry["at"]
            print(json.dumps({"heart": heart, **entry}, ensure_ascii=False))


if __name__ == "__main__":
    main(sys.argv[1:])
