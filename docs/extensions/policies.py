"""The table of the policies that ship with the package, from the records behind their cards."""

from __future__ import annotations

from collections.abc import Iterator

from agents.zoo import list_policies
from agents.zoo.shelf import load_record

CONDITIONS = ("wide_starts", "light_payload", "heavy_payload", "spin", "delay", "noise", "push")
_HEADINGS = (
    *("policy", "success", "wide starts", "light", "heavy", "spin", "delay", "noise", "push"),
    *("cost gap [%]", "training [min]"),
)


def policy_table() -> str:
    """Write what was measured of each policy.

    Returns:
        Markdown.
    """
    lines = [_HEADINGS, ("---", *("---:" for _ in _HEADINGS[1:])), *_rows()]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _rows() -> Iterator[tuple[str, ...]]:
    for name in list_policies():
        found = {evaluation["condition"]: evaluation for evaluation in load_record(name)["evaluations"]}
        trained = found["training"]
        rate, low, high = (f"{100.0 * share:.1f}" for share in trained["success_rate"])
        yield (
            f"`{name}`",
            f"{rate} [{low}, {high}]".replace(" ", "&nbsp;"),
            *(f"{100.0 * found[condition]['success_rate'][0]:.1f}" for condition in CONDITIONS),
            f"{100.0 * trained['median_cost_gap'][0]:.2g}",
            f"{trained['training_seconds'] / 60.0:.1f}",
        )
