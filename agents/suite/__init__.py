"""The suite: named, versioned tasks, and one command that flies any controller in all of them."""

from agents.suite.running import run_suite
from agents.suite.scores import Score, SuiteRun
from agents.suite.tasks import Suite, SuiteError, list_suites, load_suite

__all__ = ["Score", "Suite", "SuiteError", "SuiteRun", "list_suites", "load_suite", "run_suite"]
