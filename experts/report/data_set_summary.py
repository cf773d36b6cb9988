"""The summary of a data set: its content, how it was solved, what failed, and sample trajectories."""

from __future__ import annotations

from pathlib import Path

from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Page, Section
from experts.demonstrations import Demonstrations
from experts.demonstrations import facts as tables
from experts.demonstrations.data_card import data_card
from experts.demonstrations.facts import Facts, gather
from experts.demonstrations.folder import CARD
from experts.demonstrations.shard import REPLAY_TOLERANCE

SUMMARY = "summary"
SAMPLES = 5
"""Demonstrations shown, from the cheapest to the most expensive."""


def page(facts: Facts) -> Page:
    """The page of the summary."""
    return Page(
        f"Demonstrations of scene {facts.demonstrations.scene.name}",
        sections(facts),
        provenance(),
        f"All {facts.problems} problems are demonstrations: converged, within the tolerances, and of cost J "
        "in the environment.",
        "Not all is well",
    )


def sections(facts: Facts) -> list[Section]:
    made = [_contents(facts)]
    if len(facts.demonstrations):
        made.append(_solves(facts))
    if len(facts.failures["index"]):
        made.append(_failures(facts))
    if len(facts.demonstrations):
        made.append(_samples(facts))
    return made


def shortcomings(facts: Facts) -> list[str]:
    """Describe what should not be in a data set."""
    found = []
    if facts.return_gap > REPLAY_TOLERANCE:
        found.append(f"A return differs from -J by a relative {facts.return_gap:.1e}.")
    for quantity in facts.quantities:
        if quantity.bound is not None and (quantity.values > quantity.bound).any():
            found.append(
                f"The {quantity.name} of a demonstration exceeds {quantity.bound:g} {quantity.unit}."
            )
    return found


def _contents(facts: Facts) -> Section:
    section = Section(
        "contents",
        "What is in it",
        "Each demonstration is a local optimum from a random start, converged, successful, and replayed in "
        "the environment; with the feedback gains of the policy around it.",
        [tables.contents(facts)],
        shortcomings=shortcomings(facts),
    )
    if not len(facts.demonstrations):
        section.notes.append(f"There are no demonstrations: all {facts.problems} problems failed.")
        return section
    section.tables.append(tables.distributions(facts))
    if facts.demonstrations.kernels.n_p:
        section.tables.append(tables.parameters(facts))
    section.notes.append(
        f"The returns of {facts.replayed} demonstrations differ from -J by at most a relative "
        f"{facts.return_gap:.1e}."
    )

    def picture() -> bytes:
        from experts.figures.demonstration_figures import distributions

        return distributions(facts)

    caption = (
        "Distribution of errors, cost, share of inputs at a limit and iterations over the demonstrations, "
        "and of the times of all first solves. Dashed: tolerances."
    )
    if len(facts.failures["index"]):
        caption += " Red, on top: starts of problems that failed."
    section.add_figure("distributions", caption, picture)
    return section


def _solves(facts: Facts) -> Section:
    section = Section(
        "solves",
        "How it was solved",
        "A solve begins with the best of several guesses. Then neighbors check each other: where another "
        "problem's policy, followed from the same start, points to a cheaper minimum, the problem is solved "
        "again from there.",
        [tables.guesses(facts), tables.ends(facts)],
    )
    if facts.log.shards:
        section.tables.append(tables.times(facts))
    else:
        section.notes.append("Times are unknown: the folder has no log.")
    return section


def _failures(facts: Facts) -> Section:
    count = len(facts.failures["index"])
    return Section(
        "failures",
        "What failed",
        "Problems without a demonstration are recorded separately, with their starts.",
        [tables.failure_reasons(facts), tables.failure_list(facts)],
        shortcomings=[f"{count} of {facts.problems} problems failed ({_reasons(facts)})."],
    )


def _reasons(facts: Facts) -> str:
    return ", ".join(
        f"{count} {reason}" for reason, count in facts.demonstrations.manifest["failures"].items()
    )


def _samples(facts: Facts) -> Section:
    section = Section(
        "samples",
        "Some of the trajectories",
        "From the cheapest demonstration to the most expensive, evenly spaced in rank.",
    )

    def picture() -> bytes:
        from experts.figures.demonstration_figures import samples

        return samples(facts.demonstrations, SAMPLES)

    section.add_figure(
        "samples",
        "Above: the arm at the start and at the end, the path of its tip, and the target. Below: errors of "
        "the tip, which end below the dashed tolerances, and share of the inputs at a limit.",
        picture,
    )
    return section


def write_summary(demonstrations: Demonstrations) -> list[Path]:
    """Write the data card README.md, which follows from the data alone, and the page in `summary/`."""
    facts = gather(demonstrations)
    made = page(facts)
    folder = demonstrations.path / SUMMARY
    folder.mkdir(exist_ok=True)
    content: dict[Path, str | bytes] = {
        demonstrations.path / CARD: data_card(facts),
        folder / "summary.html": made.html(),
        folder / "summary.md": made.markdown(),
    }
    for section in made.sections:
        content |= {folder / f"{figure.name}.png": figure.png for figure in section.figures}
    for path, text in content.items():
        write_atomically(path, text)
    return list(content)
