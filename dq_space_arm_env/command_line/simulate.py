"""`dq-space-arm simulate`: one episode under any policy, written to a file for the replay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from dq_space_arm_env.command_line.names import (
    SCENE,
    normalize_option,
    seed_option,
    start_option,
    trust_option,
)
from dq_space_arm_env.command_line.policy_sources import POLICY, load_policy
from dq_space_arm_env.command_line.verb import json_option
from dq_space_arm_env.common.console import complain, message_console, print_document, table_console
from dq_space_arm_env.common.files import check_writable_file

if TYPE_CHECKING:
    from rich.console import ConsoleRenderable

    from dq_space_arm_env import Scene
    from dq_space_arm_env.environment.catches import Catch
    from dq_space_arm_env.task.trajectory import Trajectory


@click.command(
    short_help="Fly one episode: plan, feedback, or a trained policy.",
    epilog="""\b
        Examples:
          dq-space-arm simulate paper                                         # the expert's plan
          dq-space-arm simulate paper --policy gains --noise 0.05 --out a.npz  # disturbed inputs, feedback
          dq-space-arm simulate paper --policy receding --noise 0.05          # replanned at every step
          dq-space-arm simulate paper --noise joint_torque=0.02 --noise base_force=0.1  # N m, N
          dq-space-arm simulate paper --policy results/agents/ppo-0 --seed 3  # a trained agent
          dq-space-arm simulate my.yaml --policy results/solutions/my/solution.npz
    """,
)
@click.argument("scene", type=SCENE)
@click.option(
    "--policy",
    type=POLICY,
    default="plan",
    show_default=True,
    help="zero: no input; random: random inputs; plan: the expert's plan from this start, open loop; gains: "
    "the plan with its feedback gains; receding: the expert, replanning at every step; or the name of a "
    "policy of the zoo, a solution (.npz), an exported policy (.npz, .onnx), a model (.zip), or the folder "
    "of a training run.",
)
@start_option
@seed_option
@click.option(
    "--noise",
    multiple=True,
    metavar="SIGMA",
    help="Standard deviation of the disturbance of the inputs: a fraction of their limits, or "
    "ACTUATOR=NUMBER in N, N m or rad/s, such as joint_torque=0.05; may be repeated.  [default: none]",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File for the flight (.npz), which `replay` shows.",
)
@click.option("--label", help="Name of the flight in a replay.")
@normalize_option
@trust_option
@json_option
def simulate(
    scene: str,
    policy: str,
    start: str | None,
    seed: int | None,
    noise: tuple[str, ...],
    out: Path | None,
    label: str | None,
    normalize: Path | None,
    trust: bool,
    as_json: bool,
) -> None:
    """Fly one episode of SCENE, a name or a file, and report the outcome.

    Without --seed and --start it begins at the scene's own start. --seed determines start, noise and random
    inputs.
    """
    from dq_space_arm_env import load_scene
    from dq_space_arm_env.command_line.scene_warnings import limit_warnings
    from dq_space_arm_env.command_line.simulated_episode import (
        begin,
        drowned_inputs,
        final_errors,
        flown_catches,
        fly,
        numerical_error,
        read_noise,
    )

    loaded = load_scene(scene)
    if out is not None:
        check_writable_file(out, scene, policy, start, normalize)
    disturbance = read_noise(noise, loaded)
    if (drowned := drowned_inputs(disturbance, loaded)) is not None:
        complain(drowned, label="Warning: ")
    elif disturbance.any() and not all("=" in each for each in noise):  # fractions of the limits
        for warning in limit_warnings(loaded):
            complain(warning, label="Warning: ")
    begun = begin(loaded, seed, start)
    pilot = load_policy(policy, begun, message_console(), seed, trust=trust, normalize=normalize)
    flight = fly(loaded, begun, pilot, seed=seed, noise=disturbance, label=label)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        flight.save(out)
    inputs = flight.controls if flight.noise is None else flight.controls + flight.noise
    caught = flown_catches(begun, flight.states, inputs)
    error = numerical_error(begun, flight, caught)
    if as_json:
        known: dict[str, Any] = {"numerical_error": error if math.isfinite(error) else None}
        if caught:
            known["missed_catches"] = [catch.phase for catch in caught if not catch.is_met]
        print_document({**flight.facts(), **known, "file": None if out is None else str(out)})
        return
    console = table_console()
    console.print(_table(loaded, flight, final_errors(begun, flight), error, caught))
    if out is not None:
        sentence = f"{out}: watch it with `dq-space-arm replay {quote(str(out))}`"
        console.print(sentence, markup=False, soft_wrap=True)


def _table(
    scene: Scene, flight: Trajectory, errors: Sequence[float], error: float, caught: Sequence[Catch]
) -> ConsoleRenderable:
    from dq_space_arm_env.command_line.simulated_episode import catch_rows, error_rows
    from dq_space_arm_env.common.tables import plain_table

    verdict = "DIVERGED" if flight.diverged else "success" if flight.is_success else "NO success"
    charged = "" if flight.noise is None else "; noise is charged as inputs are"
    missed = not all(catch.is_met for catch in caught)
    trusted = f"m or rad, of the tip {'before the missed catch' if missed else 'at the end'}"
    if not error <= min(math.radians(scene.success.attitude_error_deg), scene.success.position_error):
        trusted += ": the motion is too fast for the time step, and its numbers mean nothing"
    rows = (
        ("start", flight.start, ""),
        ("cost J", f"{flight.cost:.6f}", "minus the sum of the rewards" + charged),
        ("steps", str(len(flight.controls)), f"{1e6 * flight.action_seconds:.0f} us for an action"),
        *(row for catch in caught for row in catch_rows(catch)),
        *error_rows(scene.success, errors),
        ("numerical error", f"{error:.1e}", trusted),
        ("end", verdict, ""),
    )
    return plain_table(f"Scene {scene.name}, {flight.label}", ("", "", ""), rows)
