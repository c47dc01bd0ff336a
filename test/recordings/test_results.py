"""results.json: plain numbers that any JSON reader takes."""

import json

from imu_fusion.recordings.results import read_results, write_results


def test_results_that_are_not_finite_become_null(tmp_path):
    write_results(tmp_path, {"node": {"a": float("nan"), "b": [1.0, float("inf")], "c": 2}})
    text = (tmp_path / "results.json").read_text()
    assert json.loads(text) == {"node": {"a": None, "b": [1.0, None], "c": 2}}
    assert "NaN" not in text and "Infinity" not in text
    assert read_results(tmp_path) == json.loads(text)


def test_a_recording_without_results_has_none(tmp_path):
    assert read_results(tmp_path) is None
