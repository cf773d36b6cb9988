"""The summary's sections: what is in a data set, how it was solved, what failed, and some trajectories."""

from __future__ import annotations

from experts.demonstrations.shard import REPLAY_TOLERANCE
from experts.report.demonstrations import tables
from experts.report.demonstrations.facts import Facts
from experts.report.page.rendering import Heading
from experts.report.page.sections import Section

SAMPLES = 5
"""Demonstrations that are drawn, from the cheapest to the costliest."""


def heading(facts: Facts) -> Heading:
    """What stands at the top of the page.

    Args:
        facts: The data set in numbers.

    Returns:
        Title, and the sentences of the verdict.
    """
    return Heading(
        f"Demonstrations of scene {facts.demonstrations.scene.name}",
        f"All {facts.problems} problems are demonstrations: converged, within the tolerances, and charged J "
        "by the environment.",
        "Not all is well",
    )


def sections(facts: Facts) -> list[Section]:
    """Make the sections.

    Args:
        facts: The data set in numbers.

    Returns:
        Contents; solves, if there are demonstrations; failures, if there are any; and sample trajectories.
    """
    made = [_contents(facts)]
    if len(facts.demonstrations):
        made.append(_solves(facts))
    if len(facts.failures["index"]):
        made.append(_failures(facts))
    if len(facts.demonstrations):
        made.append(_samples(facts))
    return made


def shortcomings(facts: Facts) -> list[str]:
    """Say what should not be in a data set.

    Args:
        facts: The data set in numbers.

    Returns:
        A sentence for each.
    """
    found = []
    if facts.return_gap > REPLAY_TOLERANCE:
        found.append(f"A return differs from -J by {facts.return_gap:.1e} of it.")
    for quantity in facts.quantities:
        if quantity.bound is not None and (quantity.values > quantity.bound).any():
            found.append(
                f"The {quantity.name} of a demonstration is beyond {quantity.bound:g} {quantity.unit}."
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
        section.notes.append(f"There is no demonstration: all {facts.problems} problems failed.")
        return section
    section.tables.append(tables.distributions(facts))
    section.notes.append(
        f"The returns of {facts.replayed} demonstrations differ from -J by at most {facts.return_gap:.1e} of "
        "it."
    )

    def picture() -> bytes:
        from experts.report.figures.demonstrations import distributions

        return distributions(facts)

    caption = (
        "How many demonstrations have which errors, cost, share of inputs at a limit, and iterations; and "
        "the times of all first solves. Dashed: tolerances."
    )
    if len(facts.failures["index"]):
        caption += " Red, on top: starts of problems that failed."
    section.draw("distributions", caption, picture)
    return section


def _solves(facts: Facts) -> Section:
    section = Section(
        "solves",
        "How it was solved",
        "A solve begins with the most promising of several guesses. Then neighbors check each other: where "
        "another problem's policy, followed from the same start, points to a cheaper minimum, the problem is "
        "solved again from there.",
        [tables.guesses(facts), tables.emphases(facts)],
    )
    if facts.log.shards:
        section.tables.append(tables.times(facts))
    else:
        section.notes.append("Times are not known: the folder has no log.")
    return section


def _failures(facts: Facts) -> Section:
    count = len(facts.failures["index"])
    return Section(
        "failures",
        "What failed",
        "Problems that led to no demonstration are recorded with their starts, and not mixed in.",
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
        "From the cheapest demonstration to the costliest, with equal numbers of others between them.",
    )

    def picture() -> bytes:
        from experts.report.figures.demonstrations import samples

        return samples(facts.demonstrations, SAMPLES)

    section.draw(
        "samples",
        "Above: where the arm is at the start and at the end, the path of its tip and the target. Below: "
        "errors of the tip, which end below the dashed tolerances, and share of the inputs at a limit.",
        picture,
    )
    return section
