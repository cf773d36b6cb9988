"""The suite: named, versioned tasks, and one command that flies any controller in all of them."""

from agents.suite.running import Score, SuiteRun, run_suite
from agents.suite.tasks import Suite, SuiteError, list_suites, load_suite

__all__ = ["Score", "Suite", "SuiteError", "SuiteRun", "list_suites", "load_suite", "run_suite"]
