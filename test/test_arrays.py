"""What a notebook does: arrays or a frame in, rows or a frame out."""

import re
import warnings
from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion import samples
from imu_fusion.arrays import orientation, to_dataframe
from imu_fusion.errors import SampleError
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.samples import ImuLog

T = 0.01 * np.arange(1200)
ANGLE = np.where(T < 3.0, 0.0, 0.5 * (1.0 - np.cos(T - 3.0)))    # about up, from rest
RATE = np.where(T < 3.0, 0.0, 0.5 * np.sin(T - 3.0))
FIELD = np.array([0.0, 20e-6, -44e-6])    # to the north and down


def turned():
    """gyr, acc, mag of a sensor that turns about up, with noise of a phone."""
    rng = np.random.default_rng(3)
    back = Rotation.from_rotvec(np.outer(ANGLE, [0.0, 0.0, 1.0])).inv()
    zero = np.zeros_like(T)
    return (np.column_stack([zero, zero, RATE]) + rng.normal(0.0, 2e-3, (len(T), 3)),
            back.apply([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.02, (len(T), 3)),
            back.apply(FIELD) + rng.normal(0.0, 3e-7, (len(T), 3)))


def test_a_frame_goes_in_and_a_frame_comes_out():
    gyr, acc, mag = turned()
    frame = pandas.DataFrame(np.hstack([gyr, acc, mag]), columns=list("abcdefghi"))
    frame.loc[frame.index % 4 > 0, ["g", "h", "i"]] = np.nan    # a slower magnetometer
    frame["t"] = pandas.to_datetime(1_700_000_000_000_000_000 + np.round(T * 1e9).astype("i8"))
    rows = orientation(frame["t"], frame[["a", "b", "c"]], frame[["d", "e", "f"]],
                       frame[["g", "h", "i"]])
    found = to_dataframe(rows)
    assert len(found) == len(T) and found["time"].iloc[-1] == pytest.approx(T[-1])
    np.testing.assert_allclose(np.radians(found["yaw_deg"]), ANGLE, atol=0.03)
    np.testing.assert_array_equal(found["cov_attitude_zz"], rows["cov_attitude"][:, 2, 2])
    assert {"quat_world_imu_w", "gyr_bias_x", "flags", "reliability"} <= set(found)


def test_times_in_seconds_and_in_nanoseconds_are_the_same():
    gyr, acc, mag = turned()
    in_seconds = orientation(T, gyr, acc, mag)
    later = orientation(np.round(T * 1e9).astype(np.int64) + 1_700_000_000_000_000_000, gyr, acc,
                        mag)
    np.testing.assert_allclose(in_seconds["quat_world_imu"], later["quat_world_imu"], atol=1e-6)


def test_a_log_becomes_a_frame():
    found = to_dataframe(ImuLog(np.array([5, 7]), np.eye(3)[:2], np.ones((2, 3))))
    assert list(found) == ["time", "stamp", "gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z"]


def test_the_page_names_every_field():
    page = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text()
    for name in (*ORIENTATION_DTYPE.names, *(log for log in samples.__all__ if "Log" in log)):
        assert f"`{name}`" in page, name


def test_what_is_wrong_is_said():
    gyr, acc, mag = turned()
    with pytest.warns(UserWarning, match="gravity in g"):
        orientation(T, gyr, acc / 9.81)
    gyr[40] = np.nan
    with pytest.warns(UserWarning, match="1 samples left out: not finite"):
        assert len(orientation(T, gyr, acc, mag)) == len(T) - 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        orientation(T[50:], gyr[50:], acc[50:])
    for arguments, words in (((T, gyr[:5], acc), r"ImuLog.gyr has shape (5, 3)"),
                             ((T, gyr, acc, mag[:5]), r"MagLog.mag has shape (5, 3)"),
                             ((gyr, gyr, acc), "t has shape"), ((1e12 * T, gyr, acc), "no times"),
                             ((T, np.nan * gyr, acc), "none of 1200 samples")):
        with pytest.raises(SampleError, match=re.escape(words)):
            orientation(*arguments)
