"""results.json: plain numbers that any JSON reader takes."""

import json

import pytest

from imu_fusion.errors import BagError
from imu_fusion.recordings.results import (
    is_incomplete,
    left_out,
    read_results,
    results_of,
    write_results,
)
from imu_fusion.samples.guard import Verdict


def test_results_that_are_not_finite_become_null(tmp_path):
    write_results(tmp_path, {"node": {"a": float("nan"), "b": [1.0, float("inf")], "c": 2}})
    text = (tmp_path / "results.json").read_text()
    assert json.loads(text) == {"node": {"a": None, "b": [1.0, None], "c": 2}}
    assert "NaN" not in text and "Infinity" not in text
    assert read_results(tmp_path) == json.loads(text)


def test_a_recording_without_results_has_none(tmp_path):
    assert read_results(tmp_path) is None


@pytest.mark.parametrize("text", ["{", "[1]", "[" * 100_000, '{"smoother": [1]}', "1" * 5000])
def test_results_of_somebody_else_are_refused_by_name(tmp_path, text):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(BagError, match="results.json"):
        results_of(tmp_path, "smoother")


@pytest.mark.parametrize("reason, lost", [
    ("cannot be decoded", True), (Verdict.NEGATIVE.value, True), (Verdict.WILD.value, True),
    (Verdict.NOT_FINITE.value, False), (Verdict.DUPLICATE.value, False)])
def test_what_is_broken_is_lost_and_what_is_repeated_or_absent_is_not(tmp_path, reason, lost):
    write_results(tmp_path, left_out({"smoother": {"fix": {reason: 1}}}, []))
    assert is_incomplete(tmp_path) == lost
