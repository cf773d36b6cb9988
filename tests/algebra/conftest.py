"""Makes `algebra_strategies` importable: with `--import-mode=importlib` pytest leaves `sys.path` alone."""

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent))
