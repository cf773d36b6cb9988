"""Mutated files are accepted and work, or are refused in a sentence, within 2 s and 500 MB."""

import os
import sys
from pathlib import Path

import pytest

pytest.importorskip("resource")

from tests.reliability.fuzzed_files import Outcome, judge
from tests.reliability.fuzzed_subjects import SUBJECTS

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="readers are judged in a fork")

FEW, MANY = 60, 10_000


def report(name: str, outcome: Outcome) -> None:
    """Print a line of the table of this suite, below the names of the tests."""
    numbers = f"{outcome.tried:6,} tried {outcome.accepted:6,} accepted {outcome.refused:6,} refused"
    costs = f"slowest {outcome.slowest:.2f} s, {outcome.memory:.0f} MB"
    sys.__stdout__.write(f"\n{name:24} {numbers} {len(outcome.failures):4} failed; {costs}\n")


def check(name: str, seeds: range, folder: Path) -> None:
    outcome = judge(SUBJECTS[name](folder), list(seeds), folder)
    if len(seeds) > FEW:
        report(name, outcome)
    assert not outcome.failures, f"{len(outcome.failures)} failures\n" + "\n".join(outcome.failures[:30])
    assert outcome.accepted + outcome.refused == outcome.tried
    assert outcome.refused


@pytest.mark.agents
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_few_mutations(name: str, tmp_path: Path) -> None:
    check(name, range(FEW), tmp_path)


@pytest.mark.endurance
@pytest.mark.parametrize("name", SUBJECTS)
def test_many_mutations(name: str, tmp_path: Path) -> None:
    check(name, range(1_000, 1_000 + int(os.environ.get("MUTATIONS", MANY))), tmp_path)
