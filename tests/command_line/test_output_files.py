"""Files that verbs write: never in place of a device or a pipe, and refused before any work."""

import os
from pathlib import Path

import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import UNUSABLE
from scripts import animate_maneuver, reproduce_paper

pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX files")

# Every line also names something that is missing, found out as soon as the work begins.
LINES = [
    "simulate planar --policy missing.npz --out {out}.npz",
    "replay missing.npz --out {out}.html",
    "scenes new {out}.yaml --from planar --force",
    "scenes import missing.urdf --out {out}.yaml --force",
    "scenes export paper --out {out}.urdf --force",  # has a wrist that cannot be written
    "evaluate show missing.npz --out {folder} --gif {out}.gif",
]


@pytest.fixture(params=["pipe", "link"])  # no device: an error here would replace that of the machine
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def occupy(out: Path, kind: str) -> None:
    pipe = out if kind == "pipe" else out.parent / "pipe"
    os.mkfifo(pipe)
    if kind == "link":
        out.symlink_to(pipe)


def check(out: Path, kind: str, error: str) -> None:
    assert f"{out} is a pipe: name a regular file, or one that does not exist" in error
    assert out.is_fifo()
    assert out.is_symlink() == (kind == "link")
    assert {path.name for path in out.parent.iterdir()} <= {out.name, "pipe"}


@pytest.mark.parametrize("line", LINES)
def test_a_verb_refuses_what_is_no_file(
    line: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = line.format(out=tmp_path / "out", folder=tmp_path / "folder").split()
    out = next(Path(word) for word in words if word.startswith(str(tmp_path / "out")))
    occupy(out, kind)
    assert main(words) == UNUSABLE
    check(out, kind, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("script", "line"),
    [
        (animate_maneuver.main, "--scene missing.yaml --out {out}"),
        (reproduce_paper.main, "--scene planar --no-figures --out {folder} --readme-picture {out}"),
    ],
)
def test_a_script_refuses_what_is_no_file(
    script: object, line: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.gif"
    occupy(out, kind)
    assert callable(script)
    assert script(line.format(out=out, folder=tmp_path / "folder").split()) == UNUSABLE
    check(out, kind, capsys.readouterr().err)


def test_a_scene_is_written_through_a_link(tmp_path: Path) -> None:
    scene, link = load_scene("planar"), tmp_path / "link.yaml"
    link.symlink_to("target.yaml")
    scene.to_yaml(link)
    assert load_scene(tmp_path / "target.yaml") == scene
    assert main(["scenes", "new", str(link), "--from", "planar", "--force"]) == 0
    assert link.is_symlink()
    assert load_scene(link).name == "link"
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    with pytest.raises(ValueError, match="is a pipe"):
        scene.to_yaml(pipe)
