"""`dq-space-arm simulate`: one episode, flown by whatever one likes, and written to a file to be replayed."""

from __future__ import annotations

from pathlib import Path

import click

from agents.command_line.names import POLICIES, POLICY, SCENE
from agents.command_line.output import check_writable, message_console, print_document, table_console
from agents.command_line.solve import start_options
from agents.command_line.verb import Verb, json_option


@click.command(
    cls=Verb,
    short_help="Fly one episode: plan, feedback, or a trained policy.",
    examples="""
        simulate paper                                             # the expert's plan
        simulate paper --policy gains --noise 0.05 --out a.npz     # disturbed inputs, feedback
        simulate paper --policy receding --noise 0.05              # planned anew at every step
        simulate paper --policy results/agents/ppo-0 --seed 3      # a trained agent
        simulate my.yaml --policy results/solutions/my/solution.npz
    """,
)
@click.argument("scene", type=SCENE)
@click.option(
    "--policy",
    type=POLICY,
    default="plan",
    show_default=True,
    help="; ".join(f"{name}: {meaning}" for name, meaning in POLICIES.items())
    + "; or a solution (.npz), an exported policy (.npz), a model (.zip), the folder of a training run, or a "
    "policy that is shipped.",
)
@start_options[1]
@start_options[0]
@click.option(
    "--noise",
    type=float,
    default=0.0,
    show_default=True,
    help="Disturbance of the inputs: standard deviation as a fraction of their limits.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File for the flight (.npz), to be replayed.",
)
@click.option("--label", help="What a replay calls the flight.")
@json_option
def simulate(
    scene: str,
    policy: str,
    start: str | None,
    seed: int | None,
    noise: float,
    out: Path | None,
    label: str | None,
    as_json: bool,
) -> None:
    """Fly one episode of SCENE, a name or a file, and say how it ends.

    Without --seed and --start it begins at the scene's own start. With --seed, start, noise and random inputs
    are those of that seed.
    """
    from agents.command_line import simulating
    from dq_space_arm_env import load_scene

    loaded = load_scene(scene)
    if out is not None:
        check_writable(out.parent)
    flight = simulating.fly(
        loaded, policy, message_console(), seed=seed, start=start, noise=noise, label=label
    )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        flight.save(out)
    if as_json:
        print_document({**flight.facts(), "file": None if out is None else str(out)})
        return
    console = table_console()
    console.print(simulating.table(flight))
    if out is not None:
        console.print(f"{out}: `dq-space-arm replay {out}` shows it", markup=False, soft_wrap=True)
