"""`dq-space-arm scenes`: list, show, validate, write, import and export scenes."""

from __future__ import annotations

import sys
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import click
from click.core import ParameterSource

from dq_space_arm_env.command_line.names import SCENE, PartOf, description_of, given, scene_files
from dq_space_arm_env.command_line.verb import json_option
from dq_space_arm_env.common.console import (
    FAILURE,
    SUCCESS,
    WIDTH,
    complain,
    has_width,
    message_console,
    print_document,
    say,
    table_console,
)
from dq_space_arm_env.common.files import check_writable_file


@click.group(
    short_help="List, show, check, write, import and export scenes.",
    epilog="""\b
        Examples:
          dq-space-arm scenes list                       # the scenes that ship
          dq-space-arm scenes show planar                # bodies, states, inputs, absent parts
          dq-space-arm scenes new my.yaml --from planar  # a commented file to edit
          dq-space-arm scenes validate my.yaml           # problems, with their lines
          dq-space-arm scenes import robot.urdf --tip hand
    """,
)
def scenes() -> None:
    """List, show, check, write, import and export scenes: a robot and its maneuver."""


@scenes.command(
    "list",
    epilog="""\b
        Examples:
          dq-space-arm scenes list
          dq-space-arm scenes list --json
    """,
)
@json_option
def list_(as_json: bool) -> None:
    """List the scenes that ship with the package."""
    found = {name: description_of(path) for name, path in scene_files().items()}
    if as_json:
        paths = scene_files()
        print_document(
            [{"name": name, "description": text, "file": str(paths[name])} for name, text in found.items()]
        )
        return
    # Click's own list, which appears before rich would be imported.
    formatter = click.HelpFormatter(width=None if has_width(sys.stdout) else WIDTH, max_width=WIDTH)
    formatter.write_dl(list(found.items()))
    click.echo(formatter.getvalue(), nl=False)


@scenes.command(
    "show",
    epilog="""\b
        Examples:
          dq-space-arm scenes show paper
          dq-space-arm scenes show my.yaml --json
    """,
)
@click.argument("scene", type=SCENE)
@json_option
def show(scene: str, as_json: bool) -> None:
    """Show bodies, states and inputs of SCENE, a name or a file, and the parts it leaves out."""
    from dq_space_arm_env import load_scene
    from dq_space_arm_env.command_line import scene_summary

    loaded = load_scene(scene)
    if as_json:
        print_document(scene_summary.record(loaded))
    else:
        scene_summary.print_scene(table_console(), loaded)


@scenes.command(
    "validate",
    epilog="""\b
        Examples:
          dq-space-arm scenes validate my.yaml
          dq-space-arm scenes validate scenes/*.yaml --json
    """,
)
@click.argument("files", nargs=-1, required=True, type=SCENE, metavar="FILE...")
@json_option
def validate(files: tuple[str, ...], as_json: bool) -> int:
    """Check scene files; list problems with their lines and fields. Exit status 1: problems found.

    Warnings say what is valid and unwise: joints too stiff for the integrator, targets out of reach, limits
    of torques out of proportion, numbers that look like grams, millimeters or degrees.
    """
    from dq_space_arm_env.command_line.scene_problems import check, step_advice, warnings

    found: list[dict[str, Any]] = []
    for file in files:
        problems = check(file)
        advice = None if problems else step_advice(file)
        listed = [each._asdict() for each in problems]
        unwise = [] if problems else warnings(file)
        facts = {"valid": not problems, "problems": listed, "advice": advice, "warnings": unwise}
        found.append({"file": file, **facts})
        if as_json:
            continue
        for problem in problems:
            where = file if problem.line is None else f"{file}:{problem.line}"
            say(f"{where}: {problem.message}")
        if not problems:
            say(f"{file}: valid")
        if advice is not None:
            say(f"{file}: warning: {advice}")
        for sentence in unwise:
            say(f"{file}: warning: {sentence}")
    if as_json:
        print_document(found)
    return SUCCESS if all(each["valid"] for each in found) else FAILURE


@scenes.command(
    "new",
    epilog="""\b
        Examples:
          dq-space-arm scenes new my.yaml                  # from scene paper
          dq-space-arm scenes new arm.yaml --from six-joint
          dq-space-arm scenes new - --from payload | less  # to standard output
    """,
)
@click.argument("file", type=click.Path(dir_okay=False, allow_dash=True))
@click.option("--from", "source", type=SCENE, default="paper", show_default=True, help="Scene to start from.")
@click.option("--name", help="Name of the scene.  [default: that of the file]")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@json_option
def new(file: str, source: str, name: str | None, force: bool, as_json: bool) -> None:
    """Write FILE, a scene with a comment at every key, for you to edit."""
    from dq_space_arm_env import load_scene
    from dq_space_arm_env.command_line.scene_template import commented_yaml

    scene = load_scene(source)
    if file == "-":
        if as_json:
            raise click.UsageError(
                "--json needs standard output for itself: name a file", click.get_current_context()
            )
        sys.stdout.write(commented_yaml(scene.replace(name=name or scene.name)))
        return
    path = _scene_file(file, force)
    _write(path, commented_yaml(scene.replace(name=name or path.stem)))
    if as_json:
        print_document({"file": str(path), "name": name or path.stem, "from": source})
    else:
        sentence = f"{path}: edit it, then `dq-space-arm scenes validate {quote(str(path))}`"
        message_console().print(sentence, markup=False, soft_wrap=True)


def _scene_file(file: str, force: bool, *read: str) -> Path:
    """Check the path of a scene to write."""
    path = Path(file)
    if path.suffix not in (".yaml", ".yml"):
        raise click.UsageError(
            f"{file}: the name of a scene file must end in .yaml", click.get_current_context()
        )
    _check_free(path, force, *read)
    return path


def _check_free(path: Path, force: bool, *read: str) -> None:
    check_writable_file(path, *read)
    if path.exists() and not force:
        raise click.UsageError(f"{path} exists: give another name, or --force", click.get_current_context())


def _write(path: Path, text: str) -> None:
    from dq_space_arm_env.common.files import write_atomically

    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text)


@scenes.command(
    "import",
    epilog="""\b
        Examples:
          dq-space-arm scenes import robot.urdf --tip hand  # robot.yaml
          dq-space-arm scenes import robot.urdf             # which links there are
          dq-space-arm scenes import panda.urdf --tip panda_hand --lock-branches
          dq-space-arm scenes import a.urdf --tip tool --spacecraft-mass 80 --spacecraft-inertia 8 8 6
          dq-space-arm scenes import a.urdf --tip tool --wheels pyramid --replay
    """,
)
@click.argument("robot", type=click.Path())
@click.option("--tip", type=PartOf("link", "robot"), help="Link that is to reach the target.")
@click.option("--base", type=PartOf("link", "robot"), help="Link that floats.  [default: the root]")
@click.option("--out", type=click.Path(dir_okay=False), help="Scene file.  [default: as ROBOT, .yaml]")
@click.option("--name", help="Name of the scene.  [default: as the file]")
@click.option("--spacecraft-mass", type=float, help="Mass of a body fixed to the base link, kg.")
@click.option(
    "--spacecraft-inertia",
    type=float,
    nargs=3,
    metavar="XX YY ZZ",
    help="Its inertia about its center of mass, which is the base link's origin unless --mount moves it, "
    "kg m^2.",
)
@click.option(
    "--mount",
    type=float,
    nargs=3,
    metavar="X Y Z",
    help="Where the base link is on that body, from its center of mass, m.  [default: there]",
)
@click.option(
    "--mount-rotation",
    type=float,
    nargs=3,
    metavar="ROLL PITCH YAW",
    help="How it is turned there, degrees, in the order of URDF's rpy.",
)
@click.option(
    "--thrusters",
    type=click.Choice(["ideal", "jets"]),
    default="ideal",
    show_default=True,
    help="ideal: a force; jets: eight jets at the corners of the spacecraft, which only push.",
)
@click.option(
    "--base-force",
    type=float,
    default=10.0,
    show_default=True,
    help="Limit of the thrusters, N, jets have half of it each; 0 for none.",
)
@click.option(
    "--wheels",
    type=click.Choice(["ideal", "pyramid", "orthogonal"]),
    default="ideal",
    show_default=True,
    help="ideal: a torque; else four or three reaction wheels with momenta and limits, in size for the "
    "mass of the base.",
)
@click.option(
    "--base-torque",
    type=float,
    default=5.0,
    show_default=True,
    help="Limit of ideal wheels, N m; 0 for none.",
)
@click.option(
    "--joint-torque", type=float, help="Limit of joints without an effort in ROBOT, N m.  [default: scaled]"
)
@click.option(
    "--passive", type=PartOf("joint", "robot"), multiple=True, help="Joint without a motor; may be repeated."
)
@click.option(
    "--full-efforts",
    is_flag=True,
    help="Keep the efforts in ROBOT as limits of the torques, for work against gravity.",
)
@click.option(
    "--dampers/--no-dampers",
    default=None,
    help="Keep the viscous damping of the joints, or leave it out.  [default: keep, but ask where it stops "
    "joints within some milliseconds]",
)
@click.option(
    "--balance-inertias",
    is_flag=True,
    help="Mend inertias that violate the triangle inequality: raise the smallest moment.",
)
@click.option(
    "--spread",
    type=click.FloatRange(min=0.0),
    default=0.1,
    show_default=True,
    help="Half-width of random starts: rad of joints and base, m of the base; 0 for none.",
)
@click.option(
    "--measure/--no-measure",
    default=True,
    help="Choose integrator and time step by measuring the error of a swing.  [default: measure]",
)
@click.option(
    "--replay",
    is_flag=True,
    help="Solve and fly the first maneuver, and open its replay in the browser: as the scene, .html.",
)
@click.option(
    "--lock-branches",
    is_flag=True,
    help="Hold all joints beside the arm at zero, or at the limit nearest to it.",
)
@click.option(
    "--lock",
    type=PartOf("joint", "robot"),
    multiple=True,
    help="Joint beside the arm, such as a gripper's, to hold likewise; may be repeated.",
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
@json_option
def import_(
    robot: str,
    tip: str | None,
    out: str | None,
    spacecraft_mass: float | None,
    spacecraft_inertia: tuple[float, float, float] | None,
    mount: tuple[float, float, float] | None,
    mount_rotation: tuple[float, float, float] | None,
    thrusters: str,
    base_force: float,
    wheels: str,
    base_torque: float,
    full_efforts: bool,
    dampers: bool | None,
    spread: float,
    measure: bool,
    replay: bool,
    lock_branches: bool,
    lock: tuple[str, ...],
    force: bool,
    as_json: bool,
    **arguments: Any,
) -> None:
    """Write a scene of ROBOT, a URDF file: its arm, from the base link to the tip, free in space.

    Other joints that move a mass are part of the scene too, unless they are locked.

    The default target is the tip's pose with every joint 0.3 rad further, or back where its
    limits ask for it. Limits of angles and rates become a constraint. Limits of torques are
    lowered to what free flight takes, and each has a weight of its own. The file has a comment
    at every key.
    """
    from dq_space_arm_env.command_line import scene_exchange
    from dq_space_arm_env.command_line.scene_template import commented_yaml

    path = _scene_file(out or f"{Path(robot).stem}.yaml", force or tip is None, robot)
    arguments["name"] = arguments.get("name") or path.stem
    if replay:
        _check_free(path.with_suffix(".html"), force, robot)
    spacecraft = given(mass=spacecraft_mass, inertia=spacecraft_inertia)
    if len(spacecraft) == 1:
        raise click.UsageError(
            "--spacecraft-mass and --spacecraft-inertia need each other; a solid cube of 1 m has mass / 6, "
            "kg m^2, about each axis",
            click.get_current_context(),
        )
    if (mount or mount_rotation) and not spacecraft:
        raise click.UsageError(
            "--mount places the arm on a spacecraft: give --spacecraft-mass and --spacecraft-inertia",
            click.get_current_context(),
        )
    context = click.get_current_context()
    if lock_branches and lock:
        raise click.UsageError("--lock-branches holds all joints beside the arm: leave --lock out", context)
    if wheels != "ideal" and context.get_parameter_source("base_torque") is ParameterSource.COMMANDLINE:
        raise click.UsageError(
            f"--base-torque limits ideal wheels, and those of --wheels {wheels} are in size for the base: "
            "leave one of them out",
            context,
        )
    if thrusters != "ideal" and base_force == 0.0:
        raise click.UsageError(
            f"--base-force 0 is for no thrusters, and those of --thrusters {thrusters} have half of it each: "
            "leave one of them out",
            context,
        )
    if spacecraft:
        spacecraft["mount"] = scene_exchange.mounted(mount, mount_rotation)
    arguments |= {
        "spacecraft": spacecraft or None,
        **given(dampers=dampers),
        "base_force": base_force or None,
        "base_torque": base_torque or None,
        "lock_branches": lock_branches or lock,
    }
    proposals = scene_exchange.Proposals(wheels, thrusters, spread, not full_efforts, measure)
    imported = scene_exchange.import_urdf(robot, tip, arguments, proposals)
    _write(path, commented_yaml(imported.scene))
    for warning in imported.warnings:
        first, *others = scene_exchange.wrapped(f"Warning: {warning}")
        complain("\n".join([first.removeprefix("Warning: "), *others]), label="Warning: ")
    if as_json:
        print_document(scene_exchange.record(imported, str(path), robot))
    else:
        for line in scene_exchange.summary(imported, str(path)):
            say(line)
    if replay:
        from dq_space_arm_env.command_line.replaying import show_maneuver

        message_console().print(
            show_maneuver(imported.scene, path.with_suffix(".html"), message_console()),
            markup=False,
            soft_wrap=True,
        )


@scenes.command(
    "export",
    epilog="""\b
        Examples:
          dq-space-arm scenes export no-wrist > no-wrist.urdf
          dq-space-arm scenes export paper --format mjcf --wrist fixed --out paper.xml
    """,
)
@click.argument("scene", type=SCENE)
@click.option("--format", "language", type=click.Choice(["urdf", "mjcf"]), default="urdf", show_default=True)
@click.option(
    "--wrist",
    type=click.Choice(["refuse", "fixed"]),
    default="refuse",
    show_default=True,
    help="fixed: write the massless wrist, which other tools lack, at its initial angles.",
)
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), help="File.  [default: standard output]"
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
def export(
    scene: str, language: str, wrist: Literal["refuse", "fixed"], out: Path | None, force: bool
) -> None:
    """Write the robot of SCENE, a name or a file, as URDF, or as MJCF for MuJoCo."""
    from dq_space_arm_env.command_line import scene_exchange

    if out is not None:
        _check_free(out, force, scene)
    text = scene_exchange.export(scene, language, wrist)
    if out is None:
        # XML is UTF-8 unless it says otherwise; where the terminal is not, names get references.
        if (sys.stdout.encoding or "").lower().replace("-", "") != "utf8":
            text = text.encode("ascii", "xmlcharrefreplace").decode()
        sys.stdout.write(text)
    else:
        _write(out, text)
        message_console().print(str(out), markup=False, soft_wrap=True)
