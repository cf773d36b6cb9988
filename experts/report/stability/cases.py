"""All cases, group by group."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

from experts.report.stability import (
    bad_numbers,
    expert,
    extreme_motions,
    far_away,
    mass_properties,
    motions,
    odd_poses,
    paper_form,
    payloads,
    stiff_joints,
    time_steps,
)
from experts.report.stability.rows import QUICK, Case, Effort, Row, run_case

GROUPS: Mapping[str, Callable[[], Iterator[Case]]] = {
    module.GROUP: module.cases
    for module in (
        mass_properties,
        motions,
        extreme_motions,
        stiff_joints,
        time_steps,
        paper_form,
        far_away,
        odd_poses,
        bad_numbers,
        payloads,
        expert,
    )
}
"""What makes the cases of each group."""


def all_cases(groups: Iterable[str] = GROUPS) -> list[Case]:
    """List cases.

    Args:
        groups: Names of groups.

    Returns:
        Their cases.

    Raises:
        ValueError: If there is no group of a name.
    """
    found: list[Case] = []
    for group in groups:
        if group not in GROUPS:
            raise ValueError(f"group: {group!r} is unknown; there are {', '.join(GROUPS)}")
        found += GROUPS[group]()
    return found


def run_cases(
    effort: Effort = QUICK,
    groups: Iterable[str] = GROUPS,
    progress: Callable[[Row], object] = lambda row: None,
) -> list[Row]:
    """Try everything.

    Args:
        effort: How much to try.
        groups: Names of groups.
        progress: Called with every row as soon as it is there.

    Returns:
        A row for each case; slow ones are left out if the effort says so.

    Raises:
        ValueError: If there is no group of a name.
    """
    rows = []
    for case in all_cases(groups):
        if case.slow and not effort.slow:
            continue
        rows.append(run_case(case, effort))
        progress(rows[-1])
    return rows
