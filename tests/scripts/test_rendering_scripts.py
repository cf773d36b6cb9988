"""The scripts that draw and time pictures: what they write, and what they refuse at once."""

import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_benchmark_writes_its_record(tmp_path, capsys):
    size = ["--width", "64", "--height", "48", "--samples", "1"]
    assert script("benchmark_rendering").main(["--scene", "planar", *size, "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "rendering.json").read_text())
    assert record["environments"][0]["name"] == "planar"
    assert record["environments"][0]["size"] == [64, 48]
    assert 0.0 < record["environments"][0]["best_ms"] <= record["environments"][0]["median_ms"]
    assert "rendering.json" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fps", "60"], "fps: 60.0, should be positive and at most 50"),
        (["--fps", "nan"], "fps: nan, should be positive"),
        (["--hold", "-1"], "hold: -1.0, should be 0 to 600 s"),
        (["--colors", "256"], "colors: 256, should be 2 to 255"),
        (["--width", "0"], "width: 0 is no number of pixels"),
    ],
)
def test_the_animation_refuses_nonsense_before_it_solves(options, sentence, tmp_path, capsys, monkeypatch):
    animate = script("animate_maneuver")
    monkeypatch.setattr(animate, "BoxDDP", lambda _: pytest.fail("solves"))
    assert animate.main([*options, "--out", str(tmp_path / "maneuver.gif")]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
