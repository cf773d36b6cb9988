"""Shared by all tests: one cache of compiled kernels for the test run, and helper modules beside the tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent / "compiler"))
