"""What a user sees while demonstrations are made."""

import math
import subprocess
import sys
from io import StringIO

import pytest
from rich.console import Console

from experts.demonstrations import Advance
from experts.demonstrations.progress import GenerationProgress, describe


def test_rates_are_those_of_this_run():
    advance = Advance(problems=100, done=60, found=20, demonstrations=57, seconds=10.0)
    assert advance.rate == 4.0
    assert advance.success_rate == 0.95
    assert advance.seconds_left == 10.0
    assert (
        describe(advance)
        == "60 of 100 problems (20 found), 95.0% demonstrations, 4.00 a second, 0:00:10 left"
    )


def test_nothing_is_claimed_before_anything_is_done():
    advance = Advance(problems=100, done=0, found=0, demonstrations=0, seconds=0.0)
    assert (advance.rate, advance.success_rate, advance.seconds_left) == (0.0, 1.0, math.inf)
    assert describe(advance) == "0 of 100 problems"
    assert Advance(problems=8, done=8, found=8, demonstrations=8, seconds=0.0).seconds_left == 0.0


@pytest.mark.parametrize("terminal", [True, False])
def test_the_last_line_stays(terminal: bool):
    output = StringIO()
    console = Console(file=output, force_terminal=terminal, width=120)
    with GenerationProgress(console) as progress:
        progress.update(Advance(20, 10, 0, 9, 2.0))
        progress.update(Advance(20, 20, 0, 19, 4.0))
    assert "20 of 20 problems, 95.0% demonstrations, 5.00 a second" in output.getvalue()


@pytest.mark.slow
def test_who_only_solves_loads_none_of_it():
    code = "import sys, experts; print(sorted({'safetensors', 'rich', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
