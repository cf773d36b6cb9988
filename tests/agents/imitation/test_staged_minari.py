"""Demonstrations whose parameters change from stage to stage, read back from Minari as they were."""

import numpy as np
import pytest

from experts.demonstrations import export_to_minari


@pytest.mark.slow
def test_moving_targets_and_phases_are_read_back(staged, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    from agents.minari_reading import read_from_minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    export_to_minari(staged, "space-arm/staged-v0")
    read = read_from_minari("space-arm/staged-v0", tmp_path / "read")
    assert read.scene == staged.scene
    for found, expected in zip(read, staged, strict=True):
        for name in ("parameters", "states", "observations", "actions", "feedback_gains"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
