"""YAML made to exhaust its reader: refused at once, in a sentence with line and column."""

import os
from collections.abc import Callable
from pathlib import Path
from time import process_time

import pytest

from dq_space_arm_env.command_line.scene_problems import check
from dq_space_arm_env.scene import SceneError, load_scene


def aliases(levels: int, width: int) -> str:
    lines = [f"a0: &a0 [{', '.join(['lol'] * width)}]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * width)}]" for i in range(1, levels)]
    return "\n".join(lines)


ATTACKS = {
    "aliases": (lambda: aliases(60, 10), "keys and values, aliases written out"),
    "aliases in mappings": (
        lambda: (
            "a: &a {k: 1}\n" + "\n".join(f"b{i}: &b{i} {{<<: [{', '.join(['*a'] * 99)}]}}" for i in range(99))
        ),
        "keys and values, aliases written out",
    ),
    "an alias inside its own": (lambda: "name: &a [*a]", r"stands inside what it stands for"),
    "many keys": (lambda: "\n".join(f"k{i}: 0" for i in range(6000)), "keys and values"),
    "five megabytes": (lambda: "- 1\n" * 1_250_000, "it should have at most"),
    "sixty-six thousand characters": (lambda: "# " + "x" * 66_000, "it should have at most"),
    "an integer of 5,000 digits": (lambda: "name: " + "9" * 5000, "an integer of 5,000 digits"),
    "a hexadecimal one": (lambda: "name: 0x" + "f" * 5000, "an integer of 5,002 digits"),
    "the 45th": (lambda: "name: 2001-13-45", "'2001-13-45' is not of the kind 'timestamp'"),
    "a time zone of days": (lambda: "name: 2001-12-14t21:59:43.10-99:00", "not of the kind 'timestamp'"),
    "no number": (lambda: "name: !!int abc", "'abc' is not of the kind 'int'"),
    "nested lists": (lambda: "name: " + "[" * 1500 + "]" * 1500, "nested deeper than 32 levels"),
    "nested dashes": (lambda: "- " * 1500, "nested deeper than 32 levels"),
    "open braces": (lambda: "{" * 60_000, "nested deeper than 32 levels"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attack_takes_one_sentence_and_a_moment(attack: str, tmp_path: Path) -> None:
    make, said = ATTACKS[attack]
    file = tmp_path / "scene.yaml"
    file.write_text(make())
    began = process_time()
    with pytest.raises(SceneError, match=said) as caught:
        load_scene(file)
    assert process_time() - began < 10.0  # generous: some took minutes
    assert len(str(caught.value)) < 600
    assert str(caught.value).startswith(str(file))
    (problem,) = check(str(file))
    assert said in problem.message


def moderate() -> str:
    return "name: box\nbase: {mass: 1, inertia: [1, 1, 1]}\ntarget: {pose: {}}\n"


def test_aliases_as_people_use_them(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(
        moderate().replace("[1, 1, 1]", "&i [1, 1, 1]")
        + "links: [{name: boom, mass: 2, inertia: *i, center_of_mass: [0, 0, 0], joint: {}}]\n"
    )
    assert load_scene(file).links[0].inertia == load_scene(file).base.inertia


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
@pytest.mark.parametrize("ending", ["yaml", "urdf"])
def test_a_pipe_is_not_waited_for(ending: str, tmp_path: Path) -> None:
    from dq_space_arm_env.interoperability.urdf_import import scene_from_urdf

    file = tmp_path / f"robot.{ending}"
    os.mkfifo(file)
    read: Callable[[Path], object] = (
        load_scene if ending == "yaml" else lambda path: scene_from_urdf(path, "tip")
    )
    with pytest.raises(SceneError, match="is a pipe, it should be a regular file"):
        read(file)
