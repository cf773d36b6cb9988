"""Shared by all tests: where helper modules are found, and signals as a terminal would send them."""

import signal
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent / "compiler"))

# A shell that runs the tests in the background lets all its processes ignore Ctrl-C, which some tests press.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
