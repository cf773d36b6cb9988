"""`dq-space-arm replay`: a solution or a rollout as a page for the browser."""

from pathlib import Path

import click

from dq_space_arm_env.command_line.names import SCENE, normalize_option, trust_option
from dq_space_arm_env.command_line.verb import json_option
from dq_space_arm_env.common.console import message_console, print_document, table_console
from dq_space_arm_env.common.files import check_writable_file


@click.command(
    short_help="Show flights in 3-D, on a page for the browser.",
    epilog="""\b
        Examples:
          dq-space-arm replay results/solutions/paper/solution.npz             # replay.html
          dq-space-arm replay results/solutions/paper/solution.npz flight.npz  # the second as a ghost
          dq-space-arm replay results/solutions/paper/solution.npz agent=results/agents/ppo-0
          dq-space-arm replay results/solutions/*                              # a list of scenes
          dq-space-arm replay "results/demonstrations/paper#3" --open          # a demonstration
    """,
)
@click.argument("flights", nargs=-1, required=True, metavar="FLIGHT...")
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("replay.html"),
    show_default=True,
    help="Page to write.",
)
@click.option(
    "--label", "labels", multiple=True, help="Name of a flight on the page; one for each, in order."
)
@click.option("--scene", type=SCENE, help="Scene to draw all flights in.  [default: each in its own]")
@click.option("--seed", type=click.IntRange(min=0), help="Start policies where env.reset(seed=...) does.")
@click.option("--open", "show", is_flag=True, help="Open the page in the browser.")
@normalize_option
@trust_option
@json_option
def replay(
    flights: tuple[str, ...],
    out: Path,
    labels: tuple[str, ...],
    scene: str | None,
    seed: int | None,
    show: bool,
    normalize: Path | None,
    trust: bool,
    as_json: bool,
) -> None:
    """Show flights in 3-D and as curves, on one page that works offline.

    FLIGHT is a solution (the file or folder from `solve`), a rollout (from `simulate`), a folder of
    demonstrations, with #3 for demonstration 3, or a policy (a file, the folder of a training run, or a name
    of the zoo), which flies from where the first flight starts. LABEL=FLIGHT names it. The first flight is
    drawn solid, the others as ghosts. Flights of different scenes are entries of a list of scenes; --scene
    draws them together.
    """
    if len(labels) > len(flights):
        raise click.UsageError(
            f"{len(labels)} labels for {len(flights)} flights: give at most one each",
            click.get_current_context(),
        )
    from dq_space_arm_env import load_scene
    from dq_space_arm_env.command_line.replaying import collect_flights, open_in_browser
    from dq_space_arm_env.viewing.replay import write_replay

    sources = [_labeled(flight) for flight in flights]
    for place, label in enumerate(labels):
        sources[place] = label, sources[place][1]
    flown = [Path(source, name) for _, source in sources for name in ("", "solution.npz")]
    check_writable_file(out, scene, normalize, *flown)
    (shown, robot), *others = collect_flights(
        sources,
        None if scene is None else load_scene(scene),
        message_console(),
        seed=seed,
        trust=trust,
        normalize=normalize,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    size = write_replay(out, shown, robot, *others).stat().st_size / 1e6
    if show:
        open_in_browser(out)
    names = [robot.name, *(scene.name for _, scene in others)]
    count = len(shown) + sum(len(flights) for flights, _ in others)
    if as_json:
        print_document({"page": str(out), "scene": robot.name, "scenes": names, "flights": count})
        return
    noun, where = "flight" if count == 1 else "flights", "scenes" if others else "scene"
    sentence = f"{out}: {count} {noun} of {where} {', '.join(names)}, {size:.1f} MB; open it in a browser"
    table_console().print(sentence, markup=False, soft_wrap=True)


def _labeled(text: str) -> tuple[str | None, str]:
    """Split LABEL=FLIGHT; a file, or the folder before "#3", may have "=" in its name."""
    label, mark, source = text.partition("=")
    is_path = Path(text).exists() or Path(text.rpartition("#")[0] or text).exists()
    if not text or not (source or is_path or not mark):
        raise click.UsageError(
            f"FLIGHT: {text!r} names none: give a file, a folder or a policy, as LABEL=FLIGHT to name it",
            click.get_current_context(silent=True),
        )
    return (None, text) if not mark or is_path else (label, source)
