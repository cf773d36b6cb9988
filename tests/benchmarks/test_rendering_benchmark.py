"""The benchmark of pictures."""

import gymnasium

from scripts.benchmarks.rendering import measure_pictures


def test_steps_and_their_pictures_are_timed() -> None:
    options = {"scene": "planar", "render_mode": "rgb_array", "width": 64, "height": 48}
    row = measure_pictures("planar", gymnasium.make("DQSpaceArm-v0", **options), 1)
    assert (row["name"], row["width"], row["height"]) == ("planar", 64, 48)
    assert 0.0 < row["best_ms"] <= row["median_ms"]
