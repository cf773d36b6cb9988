"""Machine code for lesser processors gives the results of this one's, to rounding."""

import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env.common.host_machine import host_machine

HERE = Path(__file__).parent
PROCESSORS = {
    "baseline": ("x86-64", ""),
    "avx": ("sandybridge", "avx"),
    "avx2 without fma": ("x86-64-v3", "avx,avx2"),
    "avx2 and fma": ("x86-64-v3", "avx,avx2,fma"),
    "avx-512": ("x86-64-v4", "avx,avx2,fma,avx512f"),
}
"""Names and instruction sets, as LLVM calls them."""
REGISTERS = {"baseline": "xmm", "avx-512": "zmm"}

pytestmark = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="kinds of x86-64")


def results_of(folder, scene, processor=None, whole=False):
    """The arrays of portable_results.py, compiled for a processor or for this one."""
    command = [sys.executable, HERE / "portable_results.py", folder / f"{processor}.npz", scene]
    command += ["--whole"] if whole else []
    if processor:
        cpu, features = PROCESSORS[processor]
        missing = [name for name in features.split(",") if f"+{name}," not in f"{host_machine().features},"]
        if features and missing:
            pytest.skip(f"this processor has no {', '.join(missing)}")
        command += ["--cpu", cpu, "--features", features]
    subprocess.run(command, check=True)
    with np.load(folder / f"{processor}.npz") as arrays:
        return dict(arrays)


def cases():
    slow = pytest.mark.slow
    yield pytest.param("planar", "baseline", False)
    for processor in PROCESSORS:
        if processor != "baseline":
            yield pytest.param("planar", processor, False, marks=slow)
    yield pytest.param("planar", "baseline", True, marks=slow)
    for scene in ("paper", "planar"):
        for processor in PROCESSORS:
            if (scene, processor) != ("planar", "baseline"):
                yield pytest.param(scene, processor, True, marks=pytest.mark.endurance)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "processor", "whole"), list(cases()))
def test_results_are_those_of_this_processor_to_rounding(scene, processor, whole, tmp_path: Path):
    found, expected = results_of(tmp_path, scene, processor, whole), results_of(tmp_path, scene, None, whole)
    used = set(found.pop("instructions"))
    assert REGISTERS.get(processor, "ymm") == max(used & {"xmm", "ymm", "zmm"})
    assert any(name.startswith("vf") for name in used) == ("fma" in PROCESSORS[processor][1])
    expected.pop("instructions")
    if whole:
        np.testing.assert_allclose(found.pop("J"), expected.pop("J"), rtol=1e-9)
        assert found.pop("iterations") == expected.pop("iterations")
        np.testing.assert_allclose(found.pop("states"), expected.pop("states"), rtol=0, atol=1e-6)
    assert found.keys() == expected.keys()
    for name, values in found.items():
        scale = np.abs(expected[name]).max()
        np.testing.assert_allclose(values, expected[name], rtol=0, atol=1e-13 * scale, err_msg=name)
