"""The magnetometer in the fusion filter: late, early, disturbed, or with iron beside it."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.rows import FLAG_MAG_DISTURBED, FLAG_NO_HEADING
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, earth_field, simulate
from test.estimation.orientation.errors import local_errors, rmse_deg
from test.estimation.orientation.ordinary import ORDINARY
from test.estimation.orientation.test_estimator import make


def test_a_magnetometer_that_comes_later_fixes_the_heading(ordinary):
    imu, mag, truth, _ = ordinary
    start = imu.stamp[0] + int(10e9)
    rows = OrientationEstimator().run(imu, mag[mag.stamp > start])
    known = (rows["flags"] & FLAG_NO_HEADING) == 0
    assert not known[imu.stamp <= start].any() and known[imu.stamp > start + int(0.1e9)].all()
    error = np.degrees(np.linalg.norm(local_errors(rows, truth), axis=1))
    assert error[imu.stamp > start + int(1e9)].max() < 4.0


def test_a_magnetometer_that_drops_out_is_not_missed(ordinary):
    imu, mag, truth, _ = ordinary
    gone = (mag.stamp > mag.stamp[0] + int(20e9)) & (mag.stamp < mag.stamp[0] + int(40e9))
    rows = OrientationEstimator().run(imu, mag[~gone])
    assert len(rows) == len(imu)
    assert rmse_deg(rows, truth) < 1.5


def test_a_magnet_is_refused_and_forgotten(ordinary):
    imu, mag, truth, _ = ordinary
    disturbed = mag.mag.copy()
    span = (mag.stamp > int(30e9)) & (mag.stamp < int(35e9))
    disturbed[span] += [40e-6, 20e-6, 0.0]
    rows = OrientationEstimator().run(imu, MagLog(mag.stamp, disturbed))
    clean = OrientationEstimator().run(imu, mag)
    # A disturbance that happens to keep the norm cannot be told.
    flagged = (rows["flags"] & FLAG_MAG_DISTURBED) != 0
    assert flagged[(imu.stamp > int(30.1e9)) & (imu.stamp < int(34.9e9))].mean() > 0.7
    difference = np.degrees((Rotation.from_quat(rows["quat_world_imu"]).inv()
                             * Rotation.from_quat(clean["quat_world_imu"])).magnitude())
    assert difference.max() < 2.0


def test_what_the_norm_does_not_betray_the_innovation_does(ordinary):
    """The field is turned about the vertical for 0.3 s of every 10 s: same norm, same dip."""
    imu, mag, truth, _ = ordinary
    time = (mag.stamp - mag.stamp[0]) * 1e-9
    hit = (time > 5.0) & (time % 10.0 < 0.3)
    to_world = Rotation.from_quat(truth.quat_world_imu)
    world = to_world.apply(mag.mag)
    world[hit] = Rotation.from_rotvec([0.0, 0.0, math.radians(60.0)]).apply(world[hit])
    rows = OrientationEstimator().run(imu, MagLog(mag.stamp, to_world.inv().apply(world)))
    # 0.43 deg; weighed as Gaussian noise it is 1.13, undisturbed 0.35.
    assert rmse_deg(rows, truth) < 0.7


def test_the_field_may_point_up_or_lie_level():
    for inclination in (-70.0, 0.0):
        field = earth_field(inclination=math.radians(inclination))
        imu, mag, truth, _ = simulate(Tumbling(seed=8), 15.0, field_world=field,
                                      sensors=ORDINARY, seed=4)
        assert rmse_deg(OrientationEstimator().run(imu, mag), truth) < 1.5


def test_field_of_before_the_first_imu_sample_is_not_used():
    imu, mag, _, _ = simulate(Tumbling(seed=3), 12.0, sensors=ORDINARY, seed=1)
    imu = imu[imu.stamp >= imu.stamp[0] + 6_000_000_000]
    rows = [OrientationEstimator().run(imu, m) for m in (mag, mag[mag.stamp >= imu.stamp[0]])]
    assert rows[0].tobytes() == rows[1].tobytes()


def test_magnetometer_ahead_of_the_gyroscope_is_used():
    """A negative delay makes samples wait for the Imu: all of them are used in the end."""
    for rate, lead in ((286.0, 0.03), (1000.0, 0.09)):
        imu, mag, truth, _ = simulate(Tumbling(seed=5), 6.0, rate=rate,
                                      sensors=Sensors(mag_delay=-lead, mag_sd=3e-7))
        estimator = make({"sensor.mag_delay": -lead, "mag.max_latency": 0.2})
        estimator.run(imu, mag)
        summary = estimator.summary()
        waiting = int(lead * rate) + 3      # and the sample before the first Imu
        assert summary["mag_used"] + summary["mag_disturbed"] >= len(mag.stamp) - waiting
        assert summary["mag_rejected"] <= 1


def test_lag_stays_within_belief_and_samples_in_use():
    """A field that turns when the motion begins looks like a lag: it must not end the samples."""
    imu, mag, truth, _ = simulate(Tumbling(seed=6), 30.0, rate=286.0,
                                  sensors=Sensors(mag_sd=3e-7, gyr_density=3e-4))
    false = mag.mag.copy()
    start = np.searchsorted(mag.stamp, int(2e9))
    lost = slice(start, start + 286)
    # What the sensor will show 60 ms later, for one second: a lag of six standard deviations.
    false[lost] = mag.mag[start + 17:start + 17 + 286]
    params = OrientationParams.from_mapping({"sensor.mag_delay_sd": 0.01})
    estimator = OrientationEstimator(params)
    rows = estimator.run(imu, MagLog(mag.stamp, false))
    lag = estimator.summary()["mag_delay"]
    assert abs(lag) <= 3 * params.sensor.mag_delay_sd
    assert (rows["mag_count"][-286:] > 0).mean() > 0.99


def test_iron_left_over_is_part_of_the_heading_that_rest_anchors():
    """Hard iron of 3 % of the field across magnetic north turns the needle, and is owned up to."""
    field = earth_field()
    up, north = np.array([0.0, 0.0, 1.0]), math.hypot(field[0], field[1])
    iron = 0.03 * np.linalg.norm(field)
    motion = Tumbling(seed=4, quat_start=(0.0, 0.0, 0.0, 1.0))
    imu, mag, truth, _ = simulate(motion, 2.0, sensors=Sensors(mag_offset=(iron, 0.0, 0.0)))
    rows = make({"fusion.mag_matrix_sd": 0.0}).run(imu, mag)
    error = local_errors(rows, truth)[-1] @ up
    sd = math.sqrt(rows["cov_attitude"][-1][2, 2])
    assert abs(abs(error) - math.atan2(iron, north)) < math.radians(0.3)
    assert 0.5 < abs(error) / sd < 1.5
    # Without a hypothesis of a place near iron, of which a rest tells nothing.
    rows = make({"fusion.mag_matrix_sd": 0.0, "fusion.mag_offset_sd": 0.0,
                 "fusion.local_field_sd": 0.01}).run(imu, mag)
    assert math.sqrt(rows["cov_attitude"][-1][2, 2]) < math.radians(1.5)


def test_a_heading_from_a_first_tilt_that_was_wrong_is_as_uncertain_as_that_made_it():
    """1 m/s^2 along x tilts the first sample by 5.8 deg, and a needle that dips by 63 deg is turned
    by tan(63 deg) times as much. Turning tells the tilt, but not what became of that."""
    motion = Tumbling(seed=3, quat_start=(0.0, 0.0, 0.0, 1.0), travel_sd=0.2)
    imu, mag, truth, _ = simulate(motion, 12.0, rate=100.0, seed=3)
    imu = ImuLog(imu.stamp, imu.gyr, imu.acc + [1.0, 0.0, 0.0], imu.frame_id)
    rows = OrientationEstimator(OrientationParams(declination_deg=0.0).replace(
        **{"sensor.acc_bias_sd": 1.0})).run(imu, mag)
    error = (Rotation.from_quat(rows["quat_world_imu"][-1])
             * Rotation.from_quat(truth.quat_world_imu[-1]).inv()).as_rotvec(degrees=True)
    to_world = Rotation.from_quat(truth.quat_world_imu[-1]).as_matrix()
    sd = np.degrees(np.sqrt(np.diag(to_world @ rows["cov_attitude"][-1] @ to_world.T)))
    assert np.abs(error[:2]).max() < 1.0 < 3.0 * sd[:2].min()
    assert abs(error[2] - math.degrees(math.asin(0.101)) * math.tan(math.radians(63.0))) < 1.5
    assert 0.5 * abs(error[2]) < sd[2] < 2.0 * abs(error[2])
