"""What a training says while it goes."""

import io

from rich.console import Console

from agents.imitation.progress import Generating, Labeling, TrainingAdvance
from agents.progress import ProgressDisplay
from experts.demonstrations import Advance as GenerationAdvance


def test_a_line_says_how_far_it_is_and_how_well_it_goes():
    advance = TrainingAdvance(1000, 250, 50.0, {"action": 0.3, "validation_action": 0.0123, "gain": 0.5})
    assert advance.describe() == (
        "250 of 1000 updates, action loss 1.23e-02, gain loss 5.00e-01, 50 a second, 0:00:15 left"
    )
    assert TrainingAdvance(1000, 0, 0.0, {}).describe() == "0 of 1000 updates"
    assert TrainingAdvance(1000, 1000, 50.0, {}).describe() == "1000 of 1000 updates, 50 a second"
    named = TrainingAdvance(1000, 1000, 0.0, {"success_rate": 0.5}, "round 2")
    assert named.describe() == "round 2: 1000 of 1000 updates; success 50%"


def test_other_parts_say_so_too():
    generating = Generating(GenerationAdvance(problems=10, done=4, found=0, demonstrations=4, seconds=2.0))
    assert (generating.done, generating.total) == (4, 10)
    assert generating.describe().startswith("demonstrations: 4 of 10 problems, 100.0% demonstrations")
    assert Labeling("round 1", 3, 64).describe() == "round 1: 3 of 64 flights labeled"


def test_without_a_terminal_there_is_a_line_at_first_and_at_the_end():
    stream = io.StringIO()
    with ProgressDisplay(Console(file=stream, width=200)) as progress:
        for done in range(0, 101, 10):
            progress.update(TrainingAdvance(100, done, 50.0, {}))
    lines = stream.getvalue().splitlines()
    assert [line.split(",")[0] for line in lines] == ["0 of 100 updates", "100 of 100 updates"]


def test_on_a_terminal_there_is_a_bar():
    stream = io.StringIO()
    with ProgressDisplay(Console(file=stream, width=200, force_terminal=True)) as progress:
        progress.update(TrainingAdvance(100, 50, 50.0, {"action": 0.25}))
    assert "50 of 100 updates, action loss 2.50e-01" in stream.getvalue()
