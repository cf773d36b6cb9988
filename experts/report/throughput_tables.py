"""The throughput of a scene as tables on the terminal."""

from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dq_space_arm_env.scene import INTEGRATORS
from experts.report.throughput import (
    DYNAMICS,
    ENVIRONMENT,
    MAKE,
    MAKE_VEC,
    OURS,
    SCALAR,
    STEP,
    UNWRAPPED,
    VECTOR,
    SceneThroughput,
    Timing,
    ratios,
)

TITLES = {"symplectic_euler": "Euler", "rk4": "RK4", "": ""}


def print_scene(console: Console, result: SceneThroughput) -> None:
    """Print what is measured of a scene.

    Args:
        console: Where to print.
        result: What is measured.
    """
    dynamics = select_timings(result, DYNAMICS, VECTOR, "")
    operations = dynamics[0].operations
    console.print(
        _table(
            f"Scene {result.scene}: kernels called from Python, one thread, ns per state, best (median)",
            (
                "states per call",
                f"dynamics, {operations} operations: scalar",
                "vector",
                "operations per ns",
                *(f"{TITLES[name]} step: {way}" for name in INTEGRATORS for way in ("scalar", "vector")),
            ),
            _kernel_rows(result),
        ),
        _table(
            f"Scene {result.scene}: environment steps per second, best (median)",
            ("environments", "made by", *(TITLES[name] for name in INTEGRATORS)),
            _environment_rows(result),
        ),
    )
    comparisons = list(_ratio_rows(result))
    if comparisons:
        console.print(
            _table(
                f"Scene {result.scene}: other engines, ns per state, best (median), and states per second, "
                "ours over theirs",
                ("", "engine", "theirs", "our kernel, best", "ratio", "our environment, best", "ratio"),
                comparisons,
            ),
            "The other engines are general ones, as their packages are built; our code is compiled for this "
            "scene and this processor.\nOur environment's step includes cost, observation and info, which "
            "theirs does not.\n",
        )
    console.print(
        _table(
            f"Scene {result.scene}: largest errors (dt = {result.dt:g} s)",
            ("", "engine", "compared with", "integrator", "error"),
            _agreement_rows(result),
        ),
        *(Text(note) for note in result.notes),
    )


def print_start_up(console: Console, scene: str, start_up: dict[str, list[float]]) -> None:
    """Print how long new processes take.

    Args:
        console: Where to print.
        scene: Name of the scene.
        start_up: From `measure_start_up`.
    """
    rows = [(name, f"{min(times):.2f} s", f"{_median(times):.2f} s") for name, times in start_up.items()]
    console.print(
        _table(f"New processes, scene {scene} (make: with reset and a step)", ("", "best", "median"), rows)
    )


def select_timings(result: SceneThroughput, what: str, way: str, integrator: str) -> list[Timing]:
    """Pick the timings of one kind.

    Args:
        result: Throughput of a scene.
        what: What was timed.
        way: By which code.
        integrator: Name of the integrator, empty for what takes no step.

    Returns:
        The timings, one for each batch size.
    """
    wanted = (OURS, what, way, integrator)
    return [t for t in result.timings if (t.engine, t.what, t.way, t.integrator) == wanted]


def _kernel_rows(result: SceneThroughput) -> Iterable[tuple[str, ...]]:
    columns = [(DYNAMICS, ""), *((STEP, name) for name in INTEGRATORS)]
    timings = [select_timings(result, what, way, name) for what, name in columns for way in (SCALAR, VECTOR)]
    for scalar, vector, *steps in zip(*timings, strict=True):
        rate = f"{vector.operations / vector.best_ns:.1f}" if vector.operations else ""
        yield (str(vector.batch), _ns(scalar), _ns(vector), rate, *(_ns(step) for step in steps))


def _environment_rows(result: SceneThroughput) -> Iterable[tuple[str, ...]]:
    for way, title in ((UNWRAPPED, f"{MAKE}, {UNWRAPPED}"), (MAKE, MAKE), (MAKE_VEC, MAKE_VEC)):
        for row in zip(
            *(select_timings(result, ENVIRONMENT, way, name) for name in INTEGRATORS), strict=True
        ):
            speeds = (f"{1e9 / t.best_ns:,.0f} ({1e9 / t.median_ns:,.0f})" for t in row)
            yield (str(row[0].batch), title, *speeds)


def _ratio_rows(result: SceneThroughput) -> Iterable[tuple[str, ...]]:
    for ratio in ratios(result):
        peer, kernel, environment = ratio.peer, ratio.kernel, ratio.environment
        speed = ratio.environment_speed
        yield (
            f"{TITLES[peer.integrator]} {peer.what}".strip(),
            f"{peer.engine}: {peer.way}",
            _ns(peer),
            f"{_ns(kernel)} at {kernel.batch}",
            f"{ratio.kernel_speed:.3g}",
            "" if environment is None else f"{_ns(environment)} at {environment.batch}",
            "" if speed is None else f"{speed:.3g}",
        )


def _agreement_rows(result: SceneThroughput) -> Iterable[tuple[str, ...]]:
    for agreement in result.agreements:
        unit = ", relative" if agreement.unit == "1" else f" {agreement.unit}"
        yield (
            agreement.quantity,
            agreement.engine,
            agreement.reference,
            TITLES[agreement.integrator],
            f"{agreement.error:.1e}{unit}",
        )


def _ns(timing: Timing) -> str:
    return f"{_three_digits(timing.best_ns)} ({_three_digits(timing.median_ns)})"


def _three_digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def _median(values: Sequence[float]) -> float:
    ordered, middle = sorted(values), len(values) // 2
    return ordered[middle] if len(values) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])


def _table(title: str, headings: Iterable[str], rows: Iterable[Iterable[str]]) -> Table:
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for heading in headings:
        table.add_column(Text(heading), overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table
