"""`dq-space-arm report`: every number that the project claims, measured again; all at once or in parts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click
from click.core import ParameterSource

from agents.command_line.names import SCENE, OneOf
from agents.command_line.results import destination as destination_of
from agents.command_line.results import results_options
from agents.command_line.verb import Verbs, json_option, keeping


def _parts() -> Iterable[str]:
    from experts.report.page.parts import PARTS

    return PARTS


def _measured() -> Iterable[str]:
    from experts.report.work_precision.command import MEASURED

    return MEASURED


def _methods() -> Iterable[str]:
    from experts.report.work_precision.methods import method_names

    return method_names()


def _parts_of_expert() -> Iterable[str]:
    from experts.report.solvers.effort import PARTS

    return PARTS


def _integrators() -> Iterable[str]:
    from dq_space_arm_env.scene import INTEGRATORS

    return INTEGRATORS


_GIVEN = (ParameterSource.COMMANDLINE, ParameterSource.ENVIRONMENT)
_quick = click.option("--quick", is_flag=True, help="Little of each.")
_scenes = click.option(
    "--scene", "scenes", type=SCENE, multiple=True, help="Name of a shipped scene, or YAML file; repeatable."
)


@click.group(
    cls=Verbs,
    invoke_without_command=True,
    short_help="Measure everything, or a part, with errors and times.",
    examples="""
        report --quick                      # everything, in minutes, on one page
        report paper                        # solve and replay the paper's maneuver, draw its figures
        report work-precision --case body   # one motion, all integrators
        report throughput --json            # a document for programs; tables go to standard error
    """,
)
@click.option(
    "--part",
    "parts",
    type=OneOf("part", _parts),
    multiple=True,
    help="What to measure: work_precision, stability, scene_cost, expert or throughput; repeatable. "
    "Default: all.",
)
@_quick
@results_options("report", picture=False)
@click.pass_context
def report(context: click.Context, parts: tuple[str, ...], quick: bool, out: Path, as_json: bool) -> int:
    """Measure everything and write it on one page, as HTML and as Markdown.

    Error against run time, stiff and extreme cases, what scenes leave out, the expert beside other solvers,
    and throughput, each with tables, figures, machine, versions and commit: half an hour, or minutes with
    --quick. The pages are written after each part. Exit status 1: something is less accurate than declared;
    times are never judged.
    """
    if context.invoked_subcommand is not None:
        given = [name for name in context.params if context.get_parameter_source(name) in _GIVEN]
        if given:
            raise click.UsageError(f"options go behind {context.invoked_subcommand}", context)
        return 0
    from experts.report.page import command

    with keeping(f"the parts that are measured remain in {out}"):
        return command.run(destination_of(out, as_json), parts=parts, quick=quick)


@report.command("paper", examples="report paper\nreport paper --scene payload --no-figures")
@click.option("--scene", type=SCENE, default="paper", help="Name of a shipped scene, or YAML file.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Output folder.  [default: results/<name of the scene>]",
)
@click.option("--integrator", type=OneOf("integrator", _integrators), help="In place of the scene's.")
@click.option("--max-iterations", type=int, help="In place of the solver's.")
@click.option("--figures/--no-figures", default=True, help="Whether to draw figures (needs the extra plots).")
@click.option("--pdf", is_flag=True, help="Figures also as PDF.")
@click.option(
    "--readme-picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Also draw snapshots and errors in one PNG.",
)
@json_option
def paper(
    scene: str,
    out: Path | None,
    integrator: str | None,
    max_iterations: int | None,
    figures: bool,
    pdf: bool,
    readme_picture: Path | None,
    as_json: bool,
) -> int:
    """Solve and replay the maneuver of Valverde & Tsiotras (ACC 2018), draw Figures 2 to 6.

    The output folder gets solution.npz (trajectory and feedback gains), scene.yaml, summary.json and the
    figures. Exit status 1: the solve has not converged, or the environment does not charge what was planned;
    the best trajectory is saved in any case.
    """
    from experts.report import reproduction

    loaded = reproduction.scene_with(scene, integrator)
    destination = destination_of(out or reproduction.results_folder(loaded), as_json, figures)
    return reproduction.run(
        destination, loaded, max_iterations=max_iterations, pdf=pdf, readme_picture=readme_picture
    )


@report.command(
    "work-precision", examples="report work-precision --quick\nreport work-precision --integrator rk8"
)
@click.option(
    "--case",
    "cases",
    type=OneOf("case", _measured),
    multiple=True,
    help="A motion, 'scenes' or 'formulations'; repeatable. Default: all; with --quick: the first few.",
)
@click.option(
    "--integrator",
    "integrators",
    type=OneOf("method", _methods),
    multiple=True,
    help="Repeatable. Default: all.",
)
@_quick
@results_options("work_precision")
def work_precision(
    cases: tuple[str, ...], integrators: tuple[str, ...], quick: bool, out: Path, picture: bool, as_json: bool
) -> int:
    """Measure error against run time of integrators and formulations.

    Motions: a tumbling body (30 digits), the paper's maneuver, a fast spin, a stiff joint without and with a
    damper, a chain of eight joints (SciPy's DOP853 on Pinocchio's dynamics). The tables name the cheapest
    method and step that reach 1e-3, 1e-6 and 1e-9 m and rad, and the integrator that a scene should have.
    """
    from experts.report.work_precision import command

    return command.run(
        destination_of(out, as_json, picture), quick=quick, cases=cases, integrators=integrators
    )


@report.command("stability", examples='report stability --group "stiff joints" --verbose')
@click.option("--quick", is_flag=True, help="No slow cases, fewer points (the default).")
@click.option("--full", is_flag=True, help="Every case: 1e7 steps, 20,000 stages.")
@click.option("--group", "groups", multiple=True, help="Only this group of cases; repeatable.")
@click.option("--verbose", is_flag=True, help="Print each case as soon as it is done.")
@results_options("stability")
def stability(
    quick: bool, full: bool, groups: tuple[str, ...], verbose: bool, out: Path, picture: bool, as_json: bool
) -> int:
    """Try stiff and extreme cases on everything.

    Each case has a row: handled, with its error; refused, with the sentence that the user sees; not claimed,
    with the limit of the method; or failed. Exit status 1: a case failed.
    """
    _exclude(("--quick", quick), ("--full", full))
    from experts.report.stability import command

    return command.run(destination_of(out, as_json, picture), full=full, groups=groups, verbose=verbose)


@report.command("scene-cost", examples="report scene-cost --quick --scene planar")
@_scenes
@_quick
@results_options("scene_cost")
def scene_cost(scenes: tuple[str, ...], quick: bool, out: Path, picture: bool, as_json: bool) -> int:
    """Measure what scenes leave out: what is not in a scene, not asked for or not used costs nothing.

    Sizes, operations, bytes, time and compile time of scenes and of each part left out or added; of each
    output what it costs who asks for it; of a process what it imports; megabytes on disk.
    """
    from experts.report.scene_cost import command

    return command.run(destination_of(out, as_json, picture), quick=quick, scenes=scenes)


@report.command("expert", examples="report expert --part horizon --scene payload\nreport expert --full")
@_scenes
@click.option(
    "--part",
    "parts",
    type=OneOf("part", _parts_of_expert),
    multiple=True,
    help="iterations, accuracy, starts or horizon; repeatable. Default: all.",
)
@click.option("--quick", is_flag=True, help="Little of each, and no other solvers.")
@click.option("--full", is_flag=True, help="200 starts of every shipped scene: hours.")
@click.option("--starts", type=int, help="Random starts of each scene.  [default: 40]")
@click.option("--seed", type=int, default=0, help="Of random starts and disturbances.")
@click.option("--slow-peers", is_flag=True, help="Compare also solvers that take minutes.")
@click.option("--peers/--no-peers", default=True, help="Whether to compare other solvers.")
@results_options("expert")
def expert(
    scenes: tuple[str, ...],
    parts: tuple[str, ...],
    quick: bool,
    full: bool,
    starts: int | None,
    seed: int,
    slow_peers: bool,
    peers: bool,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Measure the optimal-control expert beside other solvers, where they are installed.

    Milliseconds of an iteration by parts; seconds until the cost is within 1, 0.1 and 0.01 % of the best one
    known; random starts; the receding horizon with its disturbances. An interrupt keeps what there is.
    """
    _exclude(("--quick", quick), ("--full", full))
    from experts.report.solvers import command

    effort = command.effort_of(quick=quick, full=full, starts=starts, slow_peers=slow_peers, peers=peers)
    chosen = scenes or (() if full else ("paper",))
    return command.run(destination_of(out, as_json, picture), effort, scenes=chosen, parts=parts, seed=seed)


@report.command("throughput", examples="report throughput --quick\nreport throughput --all-scenes --features")
@_scenes
@click.option("--all-scenes", is_flag=True, help="What each shipped scene costs.")
@click.option("--features", is_flag=True, help="What each part of the first scene costs.")
@click.option("--quick", is_flag=True, help="Three batch sizes, short samples.")
@results_options("throughput")
def throughput(
    scenes: tuple[str, ...],
    all_scenes: bool,
    features: bool,
    quick: bool,
    out: Path,
    picture: bool,
    as_json: bool,
) -> int:
    """Time kernels and environments, beside Pinocchio and MuJoCo if installed.

    Every number is the best of several samples, with the median beside it: the best says what the code can
    do, a median far above it that the machine was busy. All results come with how far they are apart.
    """
    from experts.report.throughput import command

    return command.run(
        destination_of(out, as_json, picture),
        scenes=scenes,
        all_scenes=all_scenes,
        features=features,
        quick=quick,
    )


def _exclude(*options: tuple[str, bool]) -> None:
    """Refuse options that contradict each other."""
    given = [name for name, value in options if value]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given)} exclude each other", click.get_current_context())
