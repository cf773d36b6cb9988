"""Whatever ends a run, the same command given again ends it well: the same files, or a refusal in a sentence.

The whole suite takes hours. The variable KILLS is its number of moments, 20 by default; KILLS_SEED draws
others; KILLS_LOG names a file that collects the outcomes, which several runs may share.
"""

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

if not sys.platform.startswith("linux"):
    pytest.skip("it counts processes in /proc", allow_module_level=True)

import kill_harness
from kill_harness import ALONE, DISTURBANCES, ROOT, Attempt, FailedError, Undertaking, Undisturbed, disturb
from undertakings import UNDERTAKINGS, prepare

MOMENTS, SEED = int(os.environ.get("KILLS", "20")), int(os.environ.get("KILLS_SEED", "0"))
WHOLE: dict[tuple[Undertaking, Path], Undisturbed] = {}


@pytest.fixture(scope="module", autouse=True)
def path_of_runs():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join((str(ROOT), str(Path(__file__).parent))))
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Folders of inputs, of compiled kernels, and of attempts."""
    pytest.importorskip("sb3_contrib")
    pytest.importorskip("minari")
    pytest.importorskip("optuna")
    base = tmp_path_factory.mktemp("kills")
    inputs, cache = base / "inputs", base / "cache"
    inputs.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DQ_SPACE_ARM_CACHE", str(cache))
        prepare(inputs)
    shutil.rmtree(cache / "optimal-costs", ignore_errors=True)
    return inputs, cache, base / "attempts"


@pytest.fixture(scope="module")
def bare_place(tmp_path_factory):
    """The same without inputs and kernels, for commands that need none."""
    base = tmp_path_factory.mktemp("kills")
    for name in ("inputs", "cache"):
        (base / name).mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kill_harness, "PRELOADED", ("dq_space_arm_env.command_line.scene_exchange",))
        yield base / "inputs", base / "cache", base / "attempts"


def is_possible(disturbance):
    """Whether this user may mount a small disk, or make a PID namespace."""
    if disturbance not in ("full disk", "two containers, one killed"):
        return True
    tried = ["unshare", "--pid", "--mount", "--fork", "mount", "-t", "tmpfs", "none", "/mnt"]
    return shutil.which("unshare") is not None and subprocess.run(tried, capture_output=True).returncode == 0


def sweep(undertaking, place, disturbances, moments):
    """Try disturbances at random moments, and fail with all that did not end well."""
    inputs, cache, attempts = place
    if (undertaking, inputs) not in WHOLE:
        attempt = Attempt(inputs, cache, attempts / "whole")
        WHOLE[undertaking, inputs] = Undisturbed.of(undertaking, attempt, cache)
        attempt.remove()
    whole, failures = WHOLE[undertaking, inputs], []
    for disturbance in filter(is_possible, disturbances):
        for moment in moments:
            rng = np.random.default_rng([SEED, moment, *f"{undertaking.name}, {disturbance}".encode()])
            attempt = Attempt(
                inputs, cache, attempts / "a", disk=2**26 if disturbance == "full disk" else None
            )
            said = []
            try:
                outcome = disturb(undertaking, whole, attempt, disturbance, rng)
            except FailedError as failure:
                outcome, said = "failed", str(failure).splitlines()
            finally:
                attempt.heal()
                attempt.remove()
            failures += said
            if "KILLS_LOG" in os.environ:
                with Path(os.environ["KILLS_LOG"]).open("a") as log:
                    log.write("\t".join((undertaking.name, disturbance, str(moment), outcome, *said)) + "\n")
    if failures:
        pytest.fail("\n".join(failures), pytrace=False)


NEW = UNDERTAKINGS[0]


def test_killed_at_a_moment_a_new_scene_is_whole_or_not_there(bare_place):
    sweep(NEW, bare_place, ["SIGKILL", "SIGINT"], [0])


@pytest.mark.slow
@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_ended_at_some_moments_a_new_scene_ends_well_when_repeated(disturbance, bare_place):
    sweep(NEW, bare_place, [disturbance], range(2))


def cases():
    """Moment by moment, for a suite that is stopped early to have tried everything; heavy ones less often."""
    for moment in range(MOMENTS):
        for undertaking in UNDERTAKINGS:
            for disturbance in DISTURBANCES:
                share = undertaking.weight * (1.0 if disturbance in ALONE else 0.5)
                if moment < max(1, round(MOMENTS * share)):
                    yield pytest.param(
                        undertaking, disturbance, moment, id=f"{undertaking.name}-{disturbance}-{moment}"
                    )


@pytest.mark.endurance
@pytest.mark.parametrize(("undertaking", "disturbance", "moment"), list(cases()))
def test_ended_at_any_moment_it_ends_well_when_repeated(undertaking, disturbance, moment, place):
    sweep(undertaking, place, [disturbance], [moment])


def table(log: Path, column: int) -> str:
    """Count the outcomes in a log, as Markdown: by undertaking, column 0, or by disturbance, column 1."""
    outcomes = ("finished", "same", "refused", "failed")
    rows: dict[str, Counter] = {}
    for line in log.read_text().splitlines():
        fields = line.split("\t")
        for name in (fields[column], "all"):
            rows.setdefault(name, Counter())[fields[3]] += 1
    rows["all"] = rows.pop("all")
    lines = [f"| {' | '.join(('', 'tried', *outcomes))} |", "|---" + "|---:" * 5 + "|"]
    for name, found in rows.items():
        lines.append(
            f"| {' | '.join((name, str(found.total()), *(str(found[each]) for each in outcomes)))} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(Path(sys.argv[1]), 0), table(Path(sys.argv[1]), 1), sep="\n\n")
