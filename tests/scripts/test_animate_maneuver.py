"""The script that draws the animation refuses bad options before it solves."""

import pytest

from scripts import animate_maneuver


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fps", "60"], "fps: 60.0, should be positive and at most 50"),
        (["--hold", "-1"], "hold: -1.0, should be 0 to 600 s"),
        (["--colors", "256"], "colors: 256, should be 2 to 255"),
        (["--width", "0"], "width: 0 is not a positive number of pixels"),
        (["--moments", "1", "--out", "strip.png"], "moments: 1, should be at least 2: the start and the end"),
    ],
)
def test_the_animation_refuses_nonsense_before_it_solves(options, sentence, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(animate_maneuver, "GuidedDDP", lambda _: pytest.fail("solves"))
    monkeypatch.chdir(tmp_path)
    assert animate_maneuver.main(["--out", "maneuver.gif", *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
