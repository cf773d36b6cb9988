"""What a user sees while demonstrations are made."""

import math
import subprocess
import sys

import pytest

from experts.demonstrations import Advance


def test_rates_are_those_of_this_run():
    advance = Advance(problems=100, done=60, found=20, demonstrations=57, seconds=10.0)
    assert advance.rate == 4.0
    assert advance.success_rate == 0.95
    assert advance.seconds_left == 10.0
    assert (
        advance.describe()
        == "60 of 100 problems (20 found), 95.0% demonstrations, 4.00 a second, 0:00:10 left"
    )


def test_nothing_is_claimed_before_anything_is_done():
    advance = Advance(problems=100, done=0, found=0, demonstrations=0, seconds=0.0)
    assert (advance.rate, advance.success_rate, advance.seconds_left) == (0.0, 1.0, math.inf)
    assert advance.describe() == "0 of 100 problems"
    assert Advance(problems=8, done=8, found=8, demonstrations=8, seconds=0.0).seconds_left == 0.0


@pytest.mark.slow
def test_who_only_solves_loads_none_of_it():
    code = "import sys, experts; print(sorted({'safetensors', 'rich', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
