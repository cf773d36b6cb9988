"""What every test of the command line begins with."""

import pytest


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables are as wide as in a pipe, whatever has started the tests."""
    monkeypatch.delenv("COLUMNS", raising=False)
