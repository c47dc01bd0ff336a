"""Every measurement's columns against differences of its residual, its noise, its buffers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import kernel
from imu_fusion.estimation.orientation.mag_queue import TAKEN
from imu_fusion.estimation.orientation.measurements import (
    back_in_range,
    bounded_motion,
    magnetometer,
    rest,
)
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.estimation.orientation.state import HISTORY_LENGTH, MAG_SUM, QUEUE_LENGTH, new_state
from imu_fusion.kernels import njit

PARTS = ("gyro_bias", "gyro_scale", "velocity", "position", "field", "local_field", "mag_offset",
         "acc_bias", "mag_lag", "mag_matrix", "clipped_rate", "angular_acc")


@njit
def _rows(which, state, par, taken, rows):
    """The rows of one measurement in a state."""
    s, p = state[0], par[0]
    if which == 0:
        for i in range(3):
            back_in_range.clipped_rate(i, s, rows[i])
    elif which == 1:
        for i in range(3):
            rest.gyro_bias(i, s, p, rows[i])
    elif which == 2:
        for i in range(3):
            bounded_motion.velocity(i, s, p, 1.0, rows[i])
    elif which == 3:
        for i in range(3):
            bounded_motion.position(i, s, p, 1.0, rows[i])
    else:
        magnetometer.collect(s, p, taken, len(taken))
        magnetometer.field(s, p, np.zeros(es.N), rows)


MEASUREMENTS = (back_in_range.NAME, rest.NAME, bounded_motion.NAME + ", velocity",
                bounded_motion.NAME + ", position", magnetometer.NAME)


def some_state(rng):
    """A state in motion, with errors of the size that a filter has."""
    state = new_state()
    s = state[0]
    s["quat_world_imu"] = Rotation.random(random_state=4).as_quat()
    for part in PARTS:
        s[part] = 0.02 * rng.normal(size=np.shape(s[part]))
    s["mag_lag"] = 0.0
    field = rng.normal(size=3)
    s["field"] = field / np.linalg.norm(field)
    s["field_norm"], s["field_scatter"], s["heading_known"] = 48e-6, 1e-3, True
    s["cov"] = 1e-4 * np.eye(es.N)
    s["block"]["time"] = 0.02
    for name in ("gyr_last", "force_last"):
        s[name] = rng.normal(size=3)
    s["step"]["gyr"], s["rest"]["mean_rate"] = rng.normal(size=(2, 3))
    return state


def moved(state, index, amount):
    """The nominal state moved along one element of the error state."""
    state = state.copy()
    if index < es.GYRO_BIAS:
        turn = Rotation.from_rotvec(amount * np.eye(3)[index])
        state["quat_world_imu"] = (turn * Rotation.from_quat(state["quat_world_imu"])).as_quat()
        return state
    at = es.GYRO_BIAS
    for part in PARTS:
        values = state[part].reshape(-1)
        if at <= index < at + len(values):
            values[index - at] += amount
            state[part] = values.reshape(state[part].shape)
        at += len(values)
    return state


@pytest.mark.parametrize("which", range(len(MEASUREMENTS)), ids=MEASUREMENTS)
def test_columns_are_the_derivative_of_the_residual(which):
    """residual(nominal + d) = residual(nominal) - column d, to first order."""
    rng = np.random.default_rng(which)
    state, par = some_state(rng), kernel_parameters(OrientationParams())
    taken = np.zeros(2, TAKEN)
    taken["field"] = 48e-6 * rng.normal(size=(2, 3))
    taken["rate"] = rng.normal(size=(2, 3))
    taken["turn"] = Rotation.random(2, random_state=1).as_quat()

    def rows_of(state):
        rows = np.zeros(3, es.ROW)
        _rows(which, state.copy(), par, taken, rows)
        return rows

    rows = rows_of(state)
    step = 1e-6
    for index in range(es.N):
        after, before = (rows_of(moved(state, index, sign * step))["residual"]
                         for sign in (1, -1))
        column = np.array([row["coefficient"][:row["count"]][row["index"][:row["count"]] == index]
                           .sum() for row in rows])
        # The attitude's columns take the field for what is expected, not for what was measured; the
        # lag is no part of the residual, but of when a sample counts: the next test has both.
        if which == 4 and (index < es.GYRO_BIAS or index == es.MAG_LAG):
            continue
        if which == 1 and es.GYRO_SCALE <= index < es.VELOCITY:
            assert not column.any()    # left out, as the module says
            continue
        assert (after - before) / (2 * step) == pytest.approx(-column, abs=1e-6), index
    assert (rows["variance"] > 0.0).all()
    assert (rows["count"] <= es.ROW_WIDTH).all()


def test_attitude_and_lag_columns_of_a_field_that_is_as_expected():
    """Where the sample is what was predicted, these columns too are exact."""
    rng = np.random.default_rng(3)
    state, par = some_state(rng), kernel_parameters(OrientationParams())
    for part in PARTS:
        if part != "field":
            state[part] = 0.0
    world = Rotation.from_quat(state["quat_world_imu"][0])
    taken = np.zeros(1, TAKEN)
    taken["turn"] = [0.0, 0.0, 0.0, 1.0]
    taken["rate"] = rate = rng.normal(size=3)
    taken["field"] = 48e-6 * world.inv().apply(state["field"][0])
    rows = np.zeros(3, es.ROW)
    _rows(4, state.copy(), par, taken, rows)
    assert rows["residual"] == pytest.approx(np.zeros(3), abs=1e-12)
    step = 1e-6
    for index in (*range(3), es.MAG_LAG):
        found = []
        for sign in (1, -1):
            other = taken.copy()
            if index == es.MAG_LAG:
                other["turn"] = Rotation.from_rotvec(-sign * step * rate).as_quat()
            again = np.zeros(3, es.ROW)
            _rows(4, moved(state, index, sign * step), par, other, again)
            found.append(again["residual"])
        column = np.array([row["coefficient"][row["index"] == index].sum() for row in rows])
        assert (found[0] - found[1]) / (2 * step) == pytest.approx(-column, abs=1e-6), index


def test_a_norm_and_a_direction_that_deviate_weigh_less():
    state, par = some_state(np.random.default_rng(1)), kernel_parameters(OrientationParams())
    variances = []
    for size, turn in ((1.0, 0.0), (1.2, 0.0), (1.0, 1.0)):
        total = np.zeros(1, MAG_SUM)
        total["count"] = 1
        expected = state["field"][0] + state["local_field"][0]
        axis = np.cross(expected, [1.0, 0.0, 0.0])
        total["field"] = size / np.linalg.norm(expected) * Rotation.from_rotvec(
            turn * axis / np.linalg.norm(axis)).apply(expected)
        state["mag_sum"] = total
        rows = np.zeros(3, es.ROW)
        magnetometer.field(state[0], par[0], np.zeros(es.N), rows)
        variances.append(rows["variance"][0])
    assert variances[1] > 4.0 * variances[0] and variances[2] > 4.0 * variances[0]


def running():
    """Kernel state and parameters after one Imu sample, and a function that takes more."""
    state, par = new_state(), kernel_parameters(OrientationParams.from_mapping(
        {"mag.max_latency": 10.0, "gap.max": 10.0, "fusion.local_field_sd": 0.01,
         "fusion.gyro_factor": 1.0, "fusion.lasting_acc_sd": 0.0}))
    state["quat_world_imu"][0, 3] = state["history"]["quat"][0, 3] = 1.0
    state["cov"] = 1e-4 * np.eye(es.N)
    kernel._start_limits(state, par)
    rows = np.zeros(1, ORIENTATION_DTYPE)

    def imu(stamp):
        kernel.step_imu(state, par, stamp, np.array([0.0, 0.0, 0.1, 0.0, 0.0, 9.81]), rows)
    imu(0)
    return state, par, imu


def test_more_waiting_samples_than_the_queue_holds_are_counted():
    state, par, imu = running()
    for i in range(QUEUE_LENGTH + 7):
        kernel.push_mag(state, par, 1_000_000 + i, np.array([0.0, 2e-5, -4e-5]))
    assert state["counts"]["mag_rejected"] == 7
    assert state["queue"]["count"] == QUEUE_LENGTH
    assert state["queue"]["stamps"][0, 0] == 1_000_000 + 7      # the oldest went
    imu(2_000_000)
    assert state["counts"]["mag_used"] + state["counts"]["mag_disturbed"] == QUEUE_LENGTH


def test_a_sample_of_before_the_history_of_rotations_is_counted_as_late():
    state, par, imu = running()
    for i in range(1, HISTORY_LENGTH + 10):
        imu(i * 1_000_000)
    kernel.push_mag(state, par, 5_000_000, np.array([0.0, 2e-5, -4e-5]))
    kernel.push_mag(state, par, 20_000_000, np.array([0.0, 2e-5, -4e-5]))
    imu((HISTORY_LENGTH + 10) * 1_000_000)
    assert state["counts"]["mag_late"] == 1
    assert state["counts"]["mag_used"] + state["counts"]["mag_disturbed"] == 1
