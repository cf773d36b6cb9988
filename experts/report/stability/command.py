"""Stiff and extreme cases as a command: what it prints, writes, and how it ends."""

import logging
from collections.abc import Sequence

from experts.report.command import Destination, judge
from experts.report.provenance import provenance


def run(
    destination: Destination, *, full: bool = False, groups: Sequence[str] = (), verbose: bool = False
) -> int:
    """Try the cases; `stability.json` and `stability.png` tell how they went.

    Args:
        destination: Where results go.
        full: Whether to try every case, the slow ones too.
        groups: Groups of cases to try; all if there are none.
        verbose: Whether to print each case as soon as it is done.

    Returns:
        Exit status: 0, or 1 if a case failed.

    Raises:
        ValueError: If there is no such group.
    """
    from experts.report import stability
    from experts.report.stability.records import record
    from experts.report.stability.tables import failures, print_rows

    # Some hundred scenes are compiled; which, the rows say.
    logging.getLogger("dq_space_arm_env").setLevel(logging.WARNING)
    console = destination.console(width=160)
    effort = stability.FULL if full else stability.QUICK

    def show(row: stability.Row) -> None:
        if verbose:
            console.print(f"{row.seconds:6.1f} s  {row.group}: {row.name}, {row.subject}", markup=False)

    destination.folder.mkdir(parents=True, exist_ok=True)
    rows = stability.run_cases(effort, groups or stability.GROUPS, show)
    print_rows(console, rows)

    def picture() -> bytes:
        from experts.report.figures.stability import picture as draw

        return draw(rows)

    drawn = picture if any(row.curve for row in rows) else None
    destination.save(console, "stability", {**record(rows, effort), **provenance("mpmath")}, drawn)
    return judge(failures(rows))
