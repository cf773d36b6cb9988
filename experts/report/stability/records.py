"""Rows in JSON's types."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from experts.report.stability.rows import Effort, Row, Status


def record(rows: Sequence[Row], effort: Effort) -> dict[str, Any]:
    """What became of the cases.

    Args:
        rows: The rows.
        effort: How much was tried.

    Returns:
        Effort, the number of cases that ended in each way, and the fields of each row.
    """
    return {
        "effort": asdict(effort),
        "counts": {status.value: sum(row.status is status for row in rows) for status in Status},
        "rows": [{**asdict(row), "status": row.status.value} for row in rows],
    }
