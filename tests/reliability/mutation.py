"""Run mutants: apply each to a copy of the tree, and see whether a test fails.

    python tests/reliability/mutation.py [--stage quick|default|slow] [--results FILE] [--only WORD]

`mutants.jsonl` is the fixed list; a result is "caught" (a test fails, hangs, or the code does not import),
"survived", or "stale" (the line is no longer there). Only the test files of `TESTS` run, cheap ones first:
others may catch what they let through. They run in forks of a process that has imported everything, where a
mutated function gets its new code; mutants of module constants and compiled loops take a fresh process.
Results are appended to a file, and mutants that are in it are not run again.
"""

import argparse
import ast
import compileall
import contextlib
import json
import os
import py_compile
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep
from types import CodeType, FunctionType
from typing import Any, NoReturn

import pytest

ROOT = Path(__file__).parents[2]
MUTANTS = Path(__file__).with_name("mutants.jsonl")
SECONDS = 400.0
"""Most time for the tests of a mutant; one that hangs is caught."""
OPTIONS = [
    "-x",
    "-q",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
    "--tb=line",
    "-o",
    "filterwarnings=default",
]
MODEL = ("algebra", "compiler", "dynamics", "integrators", "kernels", "scene", "task", "validation")
"""Rooms whose source decides on the compiled kernels: their mutants compile anew."""

# By the start of a file's path, the first that fits: the tests that cover it. A stage runs on what survived
# the one before: "quick" takes seconds, "default" the other default tests, "slow" the slow ones of both.
_ALGEBRA = [f"tests/algebra/test_algebra_{name}.py" for name in ("poses", "screw", "tables", "api")]
_ALGEBRA.append("tests/algebra/test_algebra_accuracy.py")


def _solver(*names: str) -> dict[str, list[str]]:
    """Tests of the solver, those of one of its files first."""
    others = ("line_search", "rollout", "box_qp", "solution", "backward_pass", "second_order", "box_ddp")
    others += ("multiple_shooting", "open_gaps", "parallel_rollouts")
    quick, default = names, [name for name in others if name not in names]
    paths = [[f"tests/experts/ddp/test_{name}.py" for name in part] for part in (quick, default)]
    return dict(zip(("quick", "default"), paths, strict=True))


_KERNELS = [f"tests/kernels/test_kernels_{name}.py" for name in ("dynamics", "formulations", "derivatives")]
_ENVIRONMENT = [f"tests/environment/test_{name}.py" for name in ("episode_end", "rollouts", "environment")]
_VECTORS = [f"tests/environment/test_{name}.py" for name in ("vector_environment", "target_option")]
_METHODS = [f"tests/integrators/test_{name}.py" for name in ("explicit_runge_kutta", "integrators")]
_METHODS += [f"tests/integrators/test_{name}.py" for name in ("rosenbrock", "momentum", "dormand_prince")]

_RECEDING = "tests/experts/test_receding_horizon.py"
_RECEDING_QUICK = (
    "without_iterations_it_is_the_feedback_of_the_stage_that_has_come",
    "negative_curvature_is_cut_off_and_the_rest_stays",
    "an_iteration_lowers_the_cost_of_what_lies_ahead",
    "what_lies_beyond_the_horizon_costs_what_the_plan_says_of_its_end",
)

TESTS: dict[str, dict[str, list[str]]] = {
    "dq_space_arm_env/algebra/": {"quick": _ALGEBRA, "default": ["tests/dynamics", *_KERNELS]},
    "dq_space_arm_env/dynamics/": {"quick": ["tests/dynamics"], "default": _KERNELS},
    "dq_space_arm_env/task/trajectory.py": {
        "quick": ["tests/task/test_trajectory_files.py", "tests/environment/test_rollouts.py"],
        "default": ["tests/viewing/test_replay_flights.py"],
    },
    "dq_space_arm_env/task/": {
        "quick": ["tests/task"],
        "default": [*_ENVIRONMENT, *_VECTORS, "tests/kernels/test_kernels_randomization.py"],
    },
    "dq_space_arm_env/environment/goal": {
        "quick": [f"tests/environment/test_goal_{name}environment.py" for name in ("", "vector_")]
    },
    "dq_space_arm_env/environment/": {"quick": _ENVIRONMENT[:2], "default": _VECTORS + _ENVIRONMENT[2:]},
    "dq_space_arm_env/integrators/": {
        "quick": [
            f"tests/integrators/test_{name}.py" for name in ("tableaus", "registry", "interpreted_steps")
        ],
        "default": ["tests/kernels/test_kernels_second_order.py", *_METHODS, _KERNELS[2]],
    },
    "experts/ddp/backward_pass.py": _solver("backward_pass", "box_ddp"),
    "experts/ddp/box_ddp.py": _solver("box_ddp", "second_order"),
    "experts/ddp/directions.py": _solver("second_order", "box_ddp"),
    "experts/ddp/box_qp.py": _solver("box_qp", "backward_pass"),
    "experts/ddp/multiple_shooting.py": _solver("line_search", "multiple_shooting", "open_gaps"),
    "experts/ddp/parallel_rollouts.py": _solver("parallel_rollouts", "line_search"),
    "experts/ddp/rollout.py": _solver("rollout", "solution"),
    "experts/ddp/second_order.py": _solver("second_order", "box_ddp"),
    "experts/ddp/": _solver("line_search", "box_ddp", "second_order"),
    "experts/maneuver_plan.py": {"quick": [_RECEDING], "default": []},
    "experts/receding_horizon.py": {
        "quick": [f"{_RECEDING}::test_{name}" for name in _RECEDING_QUICK],
        "default": [_RECEDING],
    },
    "dq_space_arm_env/common/files.py": {"quick": ["tests/common"]},
    "experts/demonstrations/": {
        "quick": ["tests/demonstrations/test_folder_of_shards.py"],
        "default": ["tests/demonstrations/test_demonstrations_folder.py"],
    },
    "agents/run_folder.py": {"quick": ["tests/agents/test_run_folder.py"]},
}
STAGES = ("quick", "default", "slow")


def mutants() -> list[dict[str, Any]]:
    return [json.loads(line) for line in MUTANTS.read_text(encoding="utf-8").splitlines()]


def name_of(mutant: dict[str, Any]) -> str:
    """Name of a mutant in results, which survives when lines move."""
    return "|".join(str(mutant[key]) for key in ("file", "function", "line", "nth", "mutant"))


def mutated(source: str, mutant: dict[str, Any]) -> str | None:
    """Source with the mutant in it; None if its line is not there."""
    lines, (first, last) = source.splitlines(keepends=True), (1, len(source.splitlines()))
    if mutant["function"]:
        scope: Any = ast.parse(source)
        for name in mutant["function"].split("."):
            scope = next((node for node in scope.body if getattr(node, "name", "") == name), None)
            if scope is None:
                return None
        first, last = scope.lineno, scope.end_lineno
    places = [i for i in range(first - 1, last) if lines[i].strip() == mutant["line"]]
    if mutant["nth"] >= len(places):
        return None
    i = places[mutant["nth"]]
    lines[i] = lines[i].replace(mutant["line"], mutant["mutant"])
    return "".join(lines)


def _read(results: Path) -> dict[str, dict[str, Any]]:
    """The last record of each mutant."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    return {record["mutant"]: record for record in map(json.loads, lines)}


def outcomes(results: Path) -> dict[str, str]:
    """What became of each mutant, by its name."""
    return {name: record["outcome"] for name, record in _read(results).items()}


def tests_of(file: str, stage: str) -> list[str]:
    found = next(tests for start, tests in TESTS.items() if file.startswith(start))
    return [test for kind in found for test in found[kind]] if stage == "slow" else found.get(stage, [])


@contextlib.contextmanager
def copied_tree() -> Iterator[Path]:
    """A copy of the tree's files, compiled such that a changed source is always noticed."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Path(folder)
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
        for name in filter(None, listed.stdout.split("\0")):
            if (ROOT / name).is_file():
                (tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, tree / name)
        for package in ("agents", "dq_space_arm_env", "experts"):
            mode = py_compile.PycInvalidationMode.CHECKED_HASH
            compileall.compile_dir(tree / package, quiet=1, invalidation_mode=mode)
        yield tree


def import_everything(tree: Path) -> None:
    """Import the packages from the copied tree, and all tests that may run in forks."""
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(tree))
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)
    files = dict.fromkeys(
        test
        for tests in TESTS.values()
        for test in tests["quick"]
        if (tree / test.partition("::")[0]).exists()
    )
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):  # noqa: PTH123
        code = pytest.main([*OPTIONS, "--collect-only", "-m", "not endurance", *files])
    if code != 0:
        raise RuntimeError(f"the tests cannot be collected: {code}")


def function_of(mutant: dict[str, Any]) -> Any:
    """The function with this mutant in it, without decorators; None if its code cannot be replaced."""
    found: Any = sys.modules.get(mutant["file"].removesuffix(".py").replace("/", "."))
    for name in mutant["function"].split(".") if mutant["function"] else ():
        found = vars(found).get(name) if found is not None else None
    for attribute in ("fget", "func", "__func__", "__wrapped__"):
        found = getattr(found, attribute, found)
    return found if isinstance(found, FunctionType) else None


def code_of(source: str, path: Path, name: str) -> CodeType | None:
    """Code of a function by its qualified name."""
    left = [compile(source, str(path), "exec")]
    while left:
        code = left.pop()
        if code.co_qualname == name:
            return code
        left.extend(part for part in code.co_consts if isinstance(part, CodeType))
    return None


def run_tests(tree: Path, tests: list[str], stage: str, mutant: dict[str, Any]) -> NoReturn:
    """Run pytest in this process, and end it; output goes to a file."""
    code = 70
    try:
        output = os.open(tree / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        if mutant["file"].startswith("experts/"):
            _keep_other_loops(mutant["file"], name_of(mutant))
        marked = f"{'' if stage == 'slow' else 'not '}slow and not endurance"
        code = int(pytest.main([*OPTIONS, "-m", marked, *tests]))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def _keep_other_loops(file: str, mutant: str) -> None:
    """Compile anew only the loops of the mutated file, and those that inline it; keys hold all sources."""
    from experts.guesses import guided
    from experts.native import loop_cache

    guided.read_preparation = lambda key: None  # nor what the unmutated solver prepared
    changed = {Path(file).stem} | ({"backward_pass"} if file.endswith("box_qp.py") else set())
    loop_cache._source_hash = lambda of: mutant if Path(of).stem in changed else "as it is"


def start(tree: Path, source: str, tests: list[str], stage: str, mutant: dict[str, Any]) -> int:
    """Start the tests of a mutant whose file is in place; return the number of their process."""
    function, code = function_of(mutant), None
    if function is not None:
        code = code_of(source, tree / mutant["file"], mutant["function"])
    if code is None or code.co_freevars != function.__code__.co_freevars:
        command = [sys.executable, __file__, "--alone", str(tree), json.dumps([tests, stage, mutant])]
        return subprocess.Popen(command, start_new_session=True).pid
    child = os.fork()
    if child == 0:
        os.setsid()
        function.__code__ = code
        run_tests(tree, tests, stage, mutant)
    return child


def outcome_of(child: int, log: Path) -> str:
    """How a run of tests ends: "passed", or else why not."""
    deadline = monotonic() + SECONDS
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if monotonic() > deadline:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hangs"
        sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what the tests have left behind
    text, code = log.read_text(errors="replace"), os.waitstatus_to_exitcode(ended[1])
    if code in (0, 5):  # 5: no tests
        return "passed"
    if code == 70:
        raise RuntimeError(text)
    return next((line for line in text.splitlines() if line.startswith(("FAILED", "ERROR"))), f"exit {code}")


def run(tree: Path, mutant: dict[str, Any], stage: str) -> str:
    path = tree / mutant["file"]
    source = path.read_text(encoding="utf-8")
    changed = mutated(source, mutant)
    if changed is None:
        return "stale"
    tests = [test for test in tests_of(mutant["file"], stage) if (tree / test.partition("::")[0]).exists()]
    if not tests:
        return "survived"
    parts, kept = Path(mutant["file"]).parts, os.environ.get("DQ_SPACE_ARM_CACHE")
    if parts[0] == "dq_space_arm_env" and parts[1] in MODEL:
        os.environ["DQ_SPACE_ARM_CACHE"] = str(tree / "kernels")
    try:
        compile(changed, str(path), "exec")
        path.write_text(changed, encoding="utf-8")
        outcome = outcome_of(start(tree, changed, tests, stage, mutant), tree / "log")
    except SyntaxError:
        outcome = "no Python"
    finally:
        path.write_text(source, encoding="utf-8")
        shutil.rmtree(tree / "kernels", ignore_errors=True)
        os.environ.pop("DQ_SPACE_ARM_CACHE", None)
        if kept is not None:
            os.environ["DQ_SPACE_ARM_CACHE"] = kept
    return "survived" if outcome == "passed" else f"caught: {outcome}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stage", choices=STAGES, default="quick")
    parser.add_argument("--results", type=Path, default=Path("mutants-results.jsonl"))
    parser.add_argument("--only", default="", help="mutants whose heart or file holds this word")
    parser.add_argument("--limit", type=int, default=10**9)
    parser.add_argument("--worker", type=int, default=0, help="number of this process among those at work")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--alone", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.alone:
        tree = Path(arguments.alone[0])
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(tree))
        os.chdir(tree)
        run_tests(tree, *json.loads(arguments.alone[1]))
    results = _read(arguments.results)

    def wanted(mutant: dict[str, Any]) -> bool:
        known = results.get(name_of(mutant))
        fits = arguments.only in (mutant["heart"], "") or arguments.only in mutant["file"]
        if STAGES.index(arguments.stage) > 0:
            before = STAGES[STAGES.index(arguments.stage) - 1]
            return fits and known is not None and (known["stage"], known["outcome"]) == (before, "survived")
        return fits and known is None

    with copied_tree() as tree, arguments.results.open("a", encoding="utf-8") as file:
        import_everything(tree)
        chosen = list(filter(wanted, mutants()))
        random.Random(0).shuffle(chosen)  # however many run, they are a fair sample
        for mutant in chosen[arguments.worker :: arguments.workers][: arguments.limit]:
            began, used = monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
            outcome = run(tree, mutant, arguments.stage)
            record = {"mutant": name_of(mutant), "stage": arguments.stage, "outcome": outcome}
            now = resource.getrusage(resource.RUSAGE_CHILDREN)
            record["seconds"] = round(monotonic() - began, 1)
            record["processor_seconds"] = round(now.ru_utime - used.ru_utime, 1)
            file.write(json.dumps(record, ensure_ascii=False) + "\n")
            file.flush()


if __name__ == "__main__":
    main()
