"""Cost of scenes, of each of their parts, of outputs, new processes and the installation.

A part that a scene does not have, and an output that nobody asks for, cost nothing: neither operations nor
memory nor time to compile.
"""

from __future__ import annotations

from collections.abc import Iterator

from dq_space_arm_env import load_scene
from dq_space_arm_env.common.tables import Column
from experts.report.scene_variants import feature_variants
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Picture, Row, Table, one_by_one, time_column
from scripts.benchmarks.scene_cost.installation import installation_rows
from scripts.benchmarks.scene_cost.mechanisms import mechanism_rows
from scripts.benchmarks.scene_cost.preparations import preparation_rows
from scripts.benchmarks.scene_cost.processes import process_rows
from scripts.benchmarks.scene_cost.sizes import BATCH, output_rows, program_row, scene_rows

REFERENCE = "paper"


def measure(effort: Effort) -> Iterator[Row]:
    """Measure scenes beside `paper`; parts and outputs of the first scene that is asked for."""
    paper = load_scene(REFERENCE)
    program_row(paper, "tip_pose")  # the first program of a process also starts the compiler
    names = effort.shipped(effort.cost_scenes)
    first = load_scene(effort.scenes[0]) if effort.scenes else paper
    scenes = {name: load_scene(name) for name in dict.fromkeys((REFERENCE, *names))}
    yield from one_by_one("scenes", scene_rows("scenes", scenes, effort, vector=True))
    yield from one_by_one("parts", scene_rows("parts", feature_variants(first), effort, vector=False))
    yield from mechanism_rows(paper)
    yield from output_rows(first, effort.compilations)
    yield from process_rows(effort.processes, derivatives=effort.slow_cases)
    yield from preparation_rows((REFERENCE, *(("six-joint",) if effort.slow_cases else ())))
    yield from installation_rows()


def _tables(name: str, title: str) -> tuple[Table, Table]:
    sizes = (
        "numbers of states, tangent states, inputs, entries of an observation; memory per state in a step; "
        "machine code; seconds until it is ready for the first time; env.: step of an environment"
    )
    times = (
        f"ns per state, best, vector kernels on {BATCH:,} states; ratios to the first row; of whole steps: "
        "time of make_vec beside that with `tolerance: off`"
    )
    size_columns: list[Column | str] = ["title"]
    for key, heading in (
        ("states", "n_x"),
        ("tangent_states", "n_t"),
        ("inputs", "n_u"),
        ("observations", "n_o"),
        ("state_bytes", "state\nB"),
    ):
        size_columns.append(Column(key, heading))
    for key, heading in (("step", "step"), ("environment", "env.")):
        size_columns += [
            Column(f"{key}_memory_bytes", f"{heading}\nwork B"),
            Column(f"{key}_code_bytes", f"{heading}\ncode kB", lambda count: f"{count / 1e3:.1f}"),
            Column(f"{key}_cold_s", f"{heading}\ncold s", ".2f"),
        ]
    time_columns = (
        "title",
        Column("dynamics_operations", "dynamics\nops"),
        Column("symplectic_euler_operations", "Euler\nops"),
        Column("rk4_operations", "RK4\nops"),
        time_column("step_ns", "step\nns"),
        Column("step_ns_ratio", "ratio", ".2f"),
        Column("environment_operations", "env. step\nops"),
        Column("environment_operations_ratio", "ratio", ".2f"),
        time_column("environment_ns", "ns"),
        Column("environment_ns_ratio", "ratio", ".2f"),
        time_column("make_vec_ns", "make_vec\nns"),
        Column("of_whole_steps", "of whole\nsteps", ".2f"),
    )
    return (
        Table(name, f"{title}: size of the equations and of the compiled step\n{sizes}", tuple(size_columns)),
        Table(name, f"{title}: operations and time\n{times}", time_columns),
    )


def _bars(table: str, caption: str) -> Picture:
    plot = {"x": "environment_ns_ratio", "y": "title", "levels": (1.0,)}
    labels = {"environment_ns_ratio": "time of an environment step / that of the first"}
    return Picture(f"scene_cost_{table}", table, caption, {**plot, "labels": labels})


BENCHMARK = Benchmark(
    "scene-cost",
    "What a scene leaves out",
    "A part that a scene does not have, and an output that nobody asks for, cost nothing: neither operations "
    "nor memory nor time to compile.",
    measure,
    tables=(
        *_tables("scenes", "Scenes"),
        *_tables("parts", "Parts of a scene, one at a time"),
        Table(
            "mechanisms",
            "Actuators and mechanisms, one more at a time: operations",
            (
                "title",
                Column("states", "n_x"),
                Column("inputs", "n_u"),
                Column("dynamics", "dynamics"),
                Column("step", "RK4 step"),
                Column("step_ratio", "ratio", ".2f"),
                Column("derivatives", "its\nderivatives"),
                Column("environment", "env. step"),
            ),
        ),
        Table(
            "outputs",
            "Outputs of scene {scene}: what each costs those who ask for it",
            (
                "output",
                "program",
                "operations",
                Column("of_a_step", format=".2f"),
                Column("code_bytes", "code\nB"),
                Column("memory_bytes", "work\nB"),
                Column("trace_s", "traced\nin s", ".2f"),
                Column("compile_s", "compiled\nin s", ".2f"),
            ),
        ),
        Table(
            "processes",
            "A new process, stage by stage, scene paper; {cache} cache\nimports and programs besides those "
            "of the stages before",
            (
                "stage",
                Column("best_s", "best s", ".3f"),
                Column("median_s", "median s", ".3f"),
                "modules",
                "imports",
                "compiles",
            ),
            by=("cache",),
        ),
        Table(
            "preparations",
            "Until the expert's solver of a scene is ready: one iteration in a new process, {cache} cache\n"
            "CPU s of kernels and of the rest, loops and the iteration; s that pass in one process; "
            "CPU s and s that pass where another helps",
            (
                "title",
                Column("kernels_cpu_s", "kernels\nCPU s", ".2f"),
                Column("rest_cpu_s", "loops\nCPU s", ".2f"),
                Column("alone_wall_s", "one process\ns", ".2f"),
                Column("cpu_s", "two\nCPU s", ".2f"),
                Column("wall_s", "two\ns", ".2f"),
            ),
            by=("cache",),
        ),
        Table(
            "installation",
            "On disk, without byte code",
            (
                "title",
                "packages",
                Column("megabytes", "MB", ".1f"),
                Column("largest", "the largest, MB"),
                "missing",
            ),
        ),
    ),
    pictures=(
        _bars("scenes", "Time of an environment step of each scene."),
        _bars("parts", "Time of an environment step with one part of the scene left out or added."),
    ),
)
