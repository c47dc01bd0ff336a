"""Lengths of jumps against measured ones."""

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.errors import BagError
from imu_fusion.evaluation.jump_length import JumpLengths
from imu_fusion.recordings.jump_table import read_lengths
from imu_fusion.recordings.results import write_results

# Fang et al. 2020, table 7, and the half metre that a length by video may be off.
ESTIMATED, MEASURED = [91.6, 85.8, 98.6, 69.5, 86.0], [90.0, 85.0, 97.5, 70.0, 85.5]
BY_VIDEO = 0.5


@pytest.fixture
def table(tmp_path):
    rows = ["recording,measured"]
    for i, (length, measured) in enumerate(zip(ESTIMATED, MEASURED)):
        out = tmp_path / f"jump{i}"
        out.mkdir()
        write_results(out, {"smoother": {"jump": {"length": length, "length_sd": 1.0}}})
        rows.append(f"jump{i},{measured}")
    path = tmp_path / "lengths.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_table_7_of_the_paper(table):
    lengths = JumpLengths(*read_lengths(table))
    assert np.allclose(lengths.error, [1.6, 0.8, 1.1, -0.5, 0.5])
    # The paper rounds both to a decimetre: 1.0 and 1.5 m.
    assert abs(lengths.rms() - 0.99) < 0.005 and abs(lengths.rms(BY_VIDEO) - 1.46) < 0.005
    assert lengths.names == tuple(f"jump{i}" for i in range(5))


def test_an_error_of_measuring_counts_against_the_sign():
    short = JumpLengths(("a",), np.array([80.0]), np.array([1.0]), np.array([81.0]))
    assert short.error[0] == -1.0 and short.rms(0.5) == 1.5


def test_the_command_prints_each_jump_and_both_figures(table):
    result = CliRunner().invoke(cli, ["lengths", str(table), "--measuring-error", "0.5"])
    assert result.exit_code == 0
    text = " ".join(result.output.split())
    for part in ("jump0", "+1.60", "-0.50", "RMS 0.99 m", "1.46 m"):
        assert part in text


@pytest.mark.parametrize(("content", "told"), [
    ("recording\njump0\n", "no column measured"),
    ("recording,measured\njump0,ninety\n", "line 2: measured is 'ninety'"),
    ("recording,measured\njump0,-3\n", "line 2"),
    ("recording,measured\nelsewhere,90\n", "holds no smoothed jump"),
    ("recording,measured\n", "holds no row")])
def test_a_table_that_cannot_be_used_is_refused(table, content, told):
    table.write_text(content)
    with pytest.raises(BagError, match=told):
        read_lengths(table)
