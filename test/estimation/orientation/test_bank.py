"""Hypotheses of the local field: which one the samples choose, and what comes out of several."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation import bank
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.samples.logs import MagLog
from imu_fusion.simulation.going_round import Circles
from imu_fusion.simulation.rotation import Sensors, Tumbling, earth_field, simulate
from test.estimation.orientation.errors import local_errors, rmse_deg, tilt_errors_deg
from test.estimation.orientation.test_estimator import NOISY, feed, make


def recording(local_sd, seed=4, duration=30.0):
    """A recording in a field that differs by ``local_sd`` of its norm from place to place."""
    motion = Tumbling(seed=seed)
    imu, mag, truth, _ = simulate(motion, duration, rate=100.0, sensors=NOISY, seed=seed)
    norm, rng = np.linalg.norm(earth_field()), np.random.default_rng(seed)
    local, keep, rows = local_sd * rng.normal(size=3), math.exp(-0.01 / 0.3), []
    for t in mag.stamp * 1e-9:
        if t > motion.rest:    # one place, as long as it rests
            local = keep * local + local_sd * math.sqrt(1 - keep ** 2) * rng.normal(size=3)
        rows.append(local)
    turn = Rotation.from_quat(motion.truth(mag.stamp * 1e-9)[0])
    return imu, MagLog(mag.stamp, mag.mag + norm * turn.inv().apply(rows)), truth


@pytest.fixture(scope="module")
def beside_iron():
    return recording(0.15)


@pytest.fixture(scope="module")
def laps():
    sensors = Sensors(gyr_density=3e-4, acc_density=5e-3, gyr_bias=(0.01, -0.01, 0.005),
                      gyr_matrix=np.eye(3) + 0.004 * np.array([[1, 1, 1], [0, 1, -1], [1, 0, 1]]))
    imu, _, truth, _ = simulate(Circles(seed=1), 60.0, rate=50.0, sensors=sensors, seed=1)
    return imu, truth


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_laps_turn_neither_the_vertical_nor_the_heading(laps, mode):
    """2 m/s^2 towards the middle, for a minute: in the sensor's axes the force stands still."""
    imu, truth = laps
    estimator = make({"mode": mode})
    rows = estimator.run(imu)
    assert estimator.summary()["lasting_acc_weight"] > 0.99
    assert estimator.summary()["lasting_acc_sd"] == 1.0
    turn = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    error = np.einsum("nij,nj->ni", turn, local_errors(rows, truth))
    cov = (turn @ rows["cov_attitude"] @ turn.transpose(0, 2, 1))[:, :2, :2]
    distance = np.einsum("ni,nij,nj->n", error[:, :2], np.linalg.inv(cov), error[:, :2])
    assert (distance < 11.83).mean() > 0.95
    one = make({"mode": mode, "fusion.lasting_acc_sd": 0.0}).run(imu)
    tilt, before = (np.sqrt((tilt_errors_deg(r, truth) ** 2).mean()) for r in (rows, one))
    assert tilt < 1.5 and tilt < 0.5 * before
    drift = np.unwrap(error[:, 2])
    assert abs(np.degrees(drift[-1] - drift[0])) < 60.0 * np.degrees(0.004 + 0.003)
    # What lasts is motion: it is published.
    late = imu.stamp > imu.stamp[0] + int(20e9)
    assert rows["acc"][late] == pytest.approx(imu.acc[late], abs=0.06)


def test_the_samples_choose_the_hypothesis():
    for local_sd, expected in ((0.003, 0.01), (0.15, 0.1)):
        estimator = OrientationEstimator()
        estimator.run(*recording(local_sd)[:2])
        summary = estimator.summary()
        assert summary["local_field_sd"] == expected
        assert summary["local_field_weight"] > 0.99


def test_both_hypotheses_are_no_worse_than_the_better_one(beside_iron):
    imu, mag, truth = beside_iron
    for mode in ("causal", "smoothed"):
        one, other, both = (rmse_deg(make({"mode": mode, "fusion.local_field_sd": values}).run(
            imu, mag), truth) for values in (0.01, 0.1, (0.01, 0.1)))
        assert both < 1.1 * min(one, other), mode


def test_sample_by_sample_and_from_a_snapshot_it_is_the_same(beside_iron):
    imu, mag, _ = beside_iron
    whole = OrientationEstimator().run(imu, mag)
    assert feed(OrientationEstimator(), imu, mag).tobytes() == whole.tobytes()
    first, k = OrientationEstimator(), 1237
    j = int(np.searchsorted(mag.stamp, imu.stamp[k - 1], side="right"))
    rows = first.run(imu[:k], mag[:j])
    second = OrientationEstimator()
    second.set_state(first.get_state())
    assert np.concatenate([rows, second.run(imu[k:], mag[j:])]).tobytes() == whole.tobytes()


def test_without_a_magnetometer_hypotheses_are_one_and_part_when_it_comes(beside_iron):
    imu, mag, _ = beside_iron
    alone = make({"fusion.local_field_sd": 0.01}).run(imu)
    assert OrientationEstimator().run(imu).tobytes() == alone.tobytes()
    late = mag[1000:]
    rows = OrientationEstimator().run(imu, late)
    before = imu.stamp < late.stamp[0]
    assert rows[before].tobytes() == alone[before].tobytes()
    assert feed(OrientationEstimator(), imu, late).tobytes() == rows.tobytes()
    smoothed = make({"mode": "smoothed"}).run(imu, late)
    assert len(smoothed) == len(imu) and np.isfinite(smoothed["quat_world_imu"]).all()


def test_a_mixture_has_mean_and_covariance_of_both():
    rng = np.random.default_rng(2)
    rows = np.zeros(2, ORIENTATION_DTYPE)
    base, apart = Rotation.random(random_state=rng), np.array([0.0, 0.02, 0.0])
    weight = np.array([0.25, 0.75])
    for row, turn in zip(rows, (0.0, 1.0)):
        row["quat_world_imu"] = (base * Rotation.from_rotvec(turn * apart)).as_quat()
        row["cov_attitude"] = np.diag([1e-4, 4e-4, 9e-4])
        row["gyr_bias"], row["gyr_bias_sd"] = 0.01 * turn, 1e-3
    mixed = np.zeros(1, ORIENTATION_DTYPE)
    bank.mix_all(rows[:, None], weight, np.zeros(2), mixed)
    found = (base.inv() * Rotation.from_quat(mixed["quat_world_imu"][0])).as_rotvec()
    assert found == pytest.approx(0.75 * apart, abs=1e-9)
    spread = 0.25 * 0.75 * np.outer(apart, apart)
    assert mixed["cov_attitude"][0] == pytest.approx(
        np.diag([1e-4, 4e-4, 9e-4]) + spread, abs=2e-7)
    assert mixed["gyr_bias"][0] == pytest.approx([0.0075] * 3)
    assert mixed["gyr_bias_sd"][0] ** 2 == pytest.approx([1e-6 + 0.25 * 0.75 * 1e-4] * 3)


def test_the_number_of_hypotheses_cannot_change_while_running():
    with pytest.raises(ParameterError, match="local_field_sd"):
        OrientationEstimator().set_params(
            OrientationParams.from_mapping({"fusion.local_field_sd": 0.01}))


def test_a_magnet_that_is_passed_says_little_of_the_place_of_the_rest():
    """A twentieth of the time in a field half as large again: the heading of the first rest is
    known as well as before. Where all places differ by a third, it is not."""
    imu, mag, _ = recording(0.003)
    field = np.linalg.norm(earth_field())
    passed = mag.mag.copy()
    passed[(np.arange(len(mag)) // 50 % 20 == 10) & (mag.stamp > mag.stamp[0] + int(4e9))] += [
        0.5 * field, 0.0, 0.0]
    heading_deg = []
    for log in (mag, MagLog(mag.stamp, passed), recording(0.3)[1]):
        rows = make({"mode": "smoothed"}).run(imu, log)
        turn = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
        cov = turn @ rows["cov_attitude"] @ turn.transpose(0, 2, 1)
        heading_deg.append(np.degrees(np.sqrt(np.median(cov[:, 2, 2]))))
    assert heading_deg[1] < 1.6 * heading_deg[0] + 1.0
    assert heading_deg[2] > 10.0


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
@pytest.mark.parametrize("local_sd", [0.3, 0.6])
def test_a_magnetometer_does_no_more_harm_than_is_stated(local_sd, mode):
    """Among iron far beyond either hypothesis: what it did to the first needle shows as the sensor
    moves, from 2 s on."""
    imu, mag, truth = recording(local_sd)
    rows, without = (make({"mode": mode}).run(imu, m) for m in (mag, None))
    d = local_errors(rows, truth)
    distance = np.einsum("ni,nij,nj->n", d, np.linalg.inv(rows["cov_attitude"]), d)
    late = imu.stamp > imu.stamp[0] + int(6e9)
    assert (distance[late] < 14.16).mean() > 0.95
    tilt, alone = (np.sqrt((tilt_errors_deg(r, truth) ** 2).mean()) for r in (rows, without))
    turn = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    cov = turn @ rows["cov_attitude"] @ turn.transpose(0, 2, 1)
    assert tilt < alone + np.degrees(np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]).mean()))


@pytest.fixture(scope="module")
def laps_from_the_first_sample_on():
    sensors = Sensors(gyr_density=3e-4, acc_density=5e-3, gyr_bias=(0.01, -0.01, 0.005))
    imu, _, truth, _ = simulate(Circles(seed=1), 50.0, rate=50.0, sensors=sensors, seed=1)
    return imu[500:], truth[500:]


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_of_laps_from_the_first_sample_on_the_covariance_knows(laps_from_the_first_sample_on, mode):
    """2 m/s^2, 11.5 deg: a bias explains them as well, and the mean takes them for that."""
    imu, truth = laps_from_the_first_sample_on
    rows = make({"mode": mode}).run(imu)
    turn = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    cov = turn @ rows["cov_attitude"] @ turn.transpose(0, 2, 1)
    stated = np.degrees(np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]).mean()))
    tilt = tilt_errors_deg(rows, truth)
    assert np.sqrt((tilt ** 2).mean()) < 2.0 * stated and tilt.max() < 3.0 * stated
    without = make({"mode": mode, "fusion.lasting_acc_sd": 0.0}).run(imu)
    assert rows["quat_world_imu"] == pytest.approx(without["quat_world_imu"], abs=1e-12)


def test_a_doubt_is_part_of_the_covariance_alone():
    rows = np.zeros(2, ORIENTATION_DTYPE)
    apart = np.array([0.0, 0.02, 0.0])
    rows["quat_world_imu"] = [[0.0, 0.0, 0.0, 1.0],
                              (Rotation.from_rotvec([0.0, 0.0, 1.0])
                               * Rotation.from_rotvec(apart)).as_quat()]
    rows["cov_attitude"] = 1e-4 * np.eye(3)
    mixed = np.zeros(1, ORIENTATION_DTYPE)
    bank.mix_all(rows[:, None], np.array([1.0, 0.0]), np.array([0.0, 0.5]), mixed)
    assert mixed["quat_world_imu"][0] == pytest.approx([0.0, 0.0, 0.0, 1.0])
    # Of the other one's vertical; how it has turned about that is no doubt of this kind.
    cov = mixed["cov_attitude"][0] - 1e-4 * np.eye(3)
    assert np.trace(cov) == pytest.approx(0.5 * 0.02 ** 2, rel=1e-3)
    assert cov[2, 2] < 1e-9
