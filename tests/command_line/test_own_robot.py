"""The tutorial from a URDF file to an evaluated agent, command by command, with a real arm."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.console import SUCCESS, UNUSABLE

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own-robot.md").read_text(encoding="utf-8")


def commands() -> list[list[str]]:
    block = re.findall(r"^```bash\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return [shlex.split(line)[1:] for line in block[0].splitlines()]


@pytest.mark.endurance
def test_the_tutorial_leads_to_an_agent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    shutil.copy(ROOT / "tests" / "interoperability" / "arms" / "ur3e.urdf", "arm.urdf")
    links, import_, validate, simulate, train, evaluate = commands()
    assert main(links) == UNUSABLE
    assert "tool0" in capsys.readouterr().err
    assert main(import_) == SUCCESS
    captured = capsys.readouterr()
    assert "scaled for free flight" in captured.out
    assert "the first maneuver reaches the target" in captured.err
    assert opened == [(tmp_path / "arm.html").resolve().as_uri()]
    assert main(validate) == SUCCESS
    assert capsys.readouterr().out == "arm.yaml: valid\n"
    assert main(["solve", "arm.yaml", "--json"]) == SUCCESS
    solved = json.loads(capsys.readouterr().out)
    assert solved["converged"]
    assert solved["is_success"]
    assert main([*simulate, "--json"]) == SUCCESS
    assert json.loads(capsys.readouterr().out)["is_success"]
    with np.load("flight.npz") as flight:
        assert flight["noise"][:, 3:6].std() == pytest.approx(0.02, rel=0.1)  # N m, on the base
    assert main(train) == SUCCESS
    capsys.readouterr()
    assert main([*evaluate, "--json"]) == SUCCESS
    (found,) = json.loads(capsys.readouterr().out)
    assert found["episodes"] == 100
    assert found["success_rate"][0] >= 0.9
    assert found["violating_episodes"][0] <= 0.1
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    exec(compile(code, "own-robot.md", "exec"), {})
    assert capsys.readouterr().out == "True\n"
