"""The script that draws animations: what it refuses, and the gallery that it keeps."""

import json
from functools import partial

import numpy as np
import pytest

from dq_space_arm_env import list_scenes, load_scene
from experts import GuidedDDP
from scripts import animate_maneuver
from scripts.animate_maneuver import GALLERY, MOMENTS, RECORDS, SMALL, draw_gallery

LARGEST, LARGEST_IN_ALL = 120_000, 2_500_000  # bytes


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fps", "60"], "fps: 60.0, should be positive and at most 50"),
        (["--seconds", "nan"], "seconds: nan, should be positive"),
        (["--hold", "-1"], "hold: -1.0, should be 0 to 600 s"),
        (["--colors", "256"], "colors: 256, should be 2 to 255"),
        (["--width", "0"], "width: 0 is not a positive number of pixels"),
        (["--out", "maneuver.webp"], "out: maneuver.webp, should end in .gif or .png"),
        (["--moments", "1", "--out", "strip.png"], "moments: 1, should be at least 2: the start and the end"),
    ],
)
def test_the_animation_refuses_nonsense_before_it_solves(options, sentence, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(animate_maneuver, "GuidedDDP", lambda _: pytest.fail("solves"))
    monkeypatch.chdir(tmp_path)
    assert animate_maneuver.main(["--out", "maneuver.gif", *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_single_picture_is_called_one(tmp_path, capsys, monkeypatch):
    pytest.importorskip("PIL.Image")
    monkeypatch.setattr(animate_maneuver, "GuidedDDP", partial(GuidedDDP, max_iterations=0))
    options = ["--scene", "planar", "--seconds", "0.001", "--width", "16", "--height", "16"]
    assert animate_maneuver.main([*options, "--out", str(tmp_path / "a.gif")]) == 0
    assert "a.gif: 1 picture, " in capsys.readouterr().out


def test_the_gallery_is_complete_small_and_of_the_present_scenes():
    records = json.loads((GALLERY / RECORDS).read_text(encoding="utf-8"))
    assert list(records) == list_scenes()
    for name, record in records.items():
        draw = f"run python scripts/animate_maneuver.py --gallery {name}"
        assert record["scene"] == load_scene(name).content_hash(), draw
    sizes = {path.stem: path.stat().st_size for path in GALLERY.glob("*.webp")}
    assert sorted(sizes) == list_scenes()
    assert max(sizes.values()) < LARGEST
    assert sum(sizes.values()) < LARGEST_IN_ALL


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["paper", "planar", "free-floating", "tracking", "joint-limits"])
def test_the_gallery_shows_what_the_expert_finds(name, tmp_path, capsys):
    """Facts and pictures made anew are those that ship, whatever other pictures are there."""
    pillow = pytest.importorskip("PIL.Image")
    (tmp_path / RECORDS).write_text(json.dumps({"gone": {}}), encoding="utf-8")
    assert draw_gallery([name], tmp_path) == 0
    records = json.loads((tmp_path / RECORDS).read_text(encoding="utf-8"))
    assert list(records) == [name]
    shipped = json.loads((GALLERY / RECORDS).read_text(encoding="utf-8"))[name]
    assert records[name].pop("scene") == shipped.pop("scene")
    assert records[name] == pytest.approx(shipped, rel=1e-3, abs=1e-6)
    ours, theirs = (pillow.open(folder / f"{name}.webp") for folder in (tmp_path, GALLERY))
    frames = []
    assert ours.n_frames == theirs.n_frames == MOMENTS
    for number in (0, MOMENTS // 2, MOMENTS - 1):
        ours.seek(number)
        theirs.seek(number)
        frames.append(np.asarray(ours.convert("RGB")).astype(int))
        assert frames[-1].shape == (SMALL.height, SMALL.width, 3)
        assert np.abs(frames[-1] - np.asarray(theirs.convert("RGB"))).mean() < 3.0
    assert np.abs(frames[1] - frames[0]).mean() > 3.0, "the arm moves"
    assert f"1 of 1: {name}.webp" in capsys.readouterr().out


def test_the_gallery_leaves_out_what_it_has_and_what_has_not_converged(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(animate_maneuver, "list_scenes", lambda: ["paper", "planar"])
    record = {"scene": load_scene("paper").content_hash(), "cost": 1.0}
    (tmp_path / RECORDS).write_text(json.dumps({"paper": record}), encoding="utf-8")
    (tmp_path / "paper.webp").touch()
    monkeypatch.setattr(animate_maneuver, "GuidedDDP", partial(GuidedDDP, max_iterations=0))
    assert draw_gallery((), tmp_path) == 1
    assert "planar: not drawn, " in " ".join(capsys.readouterr().err.split())
    assert json.loads((tmp_path / RECORDS).read_text(encoding="utf-8")) == {"paper": record}
    assert sorted(path.name for path in tmp_path.iterdir()) == [RECORDS, "paper.webp"]
