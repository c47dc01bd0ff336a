"""Each parameter where it matters; what does nothing, and old names, are refused."""

import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.rows import (
    FLAG_ALIGNING,
    FLAG_GAP,
    FLAG_MAG_DISTURBED,
    FLAG_STILL,
)
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Tumbling, earth_field, simulate
from test.estimation.orientation.test_estimator import NOISY, make

PRINTED = {"method": "gyro_mag", "gyro_mag.as_printed": True}


@pytest.fixture(scope="module")
def moving():
    return simulate(Tumbling(seed=1), 12.0, rate=200.0, mag_rate=50.0, sensors=NOISY, seed=2)


@pytest.fixture(scope="module")
def resting():
    """Level, x to the east, with noise of 2 mrad/s and 0.02 m/s^2; the field is north."""
    rng = np.random.default_rng(1)
    n = 2000
    stamp = np.arange(n, dtype=np.int64) * 5_000_000
    mag = rng.normal(0, 1e-7, (n, 3)) + earth_field()
    return (ImuLog(stamp, rng.normal(0, 2e-3, (n, 3)),
                   rng.normal(0, 0.02, (n, 3)) + [0, 0, 9.80665]), MagLog(stamp, mag))


def run(logs, changes):
    return make(changes).run(*logs[:2])


def world_covariances(rows):
    r = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
    return r @ rows["cov_attitude"] @ r.transpose(0, 2, 1)


def still(rows):
    return ((rows["flags"] & FLAG_STILL) != 0).mean()


def test_alignment_duration_is_the_first_interval(moving):
    for duration in (0.5, 1.0):
        rows = run(moving, {"alignment.duration": duration})
        assert ((rows["flags"] & FLAG_ALIGNING) != 0).sum() == 200 * duration + 1


def test_yaw_offset_turns_the_world_about_the_vertical(resting):
    yaw = [Rotation.from_quat(run(resting, {"alignment.yaw_offset_deg": offset})
                              ["quat_world_imu"][-1]).as_euler("ZYX", degrees=True)[0]
           for offset in (0.0, 30.0)]
    assert yaw[1] - yaw[0] == pytest.approx(30.0, abs=1e-6)


@pytest.mark.parametrize("anchor", ["rest", "field"])
def test_heading_sd_is_that_of_the_first_heading_and_of_north(resting, anchor):
    variances = [world_covariances(run(resting, {
        "alignment.heading_sd_deg": sd, "alignment.heading_anchor": anchor}))[-1, 2, 2]
        for sd in (1.0, 5.0)]
    assert variances[1] - variances[0] == pytest.approx(math.radians(5) ** 2 - math.radians(1) ** 2,
                                                        rel=1e-6)


def test_gyro_delay_sd_is_part_of_the_covariance_while_turning(moving):
    """With half a step, evenly distributed, between rates at their stamps and means of a step."""
    # Of one hypothesis: a mixture's is added in the axes of each.
    rows = [run(moving, {"sensor.gyro_delay_sd": sd, "fusion.local_field_sd": 0.01,
                         "fusion.lasting_acc_sd": 0.0,
                         "fusion.gyro_factor": 1.0})
            for sd in (0.0, 0.01)]
    added = rows[1]["cov_attitude"] - rows[0]["cov_attitude"]
    rate = rows[0]["gyr"]
    step = np.diff(rows[0]["stamp"], prepend=rows[0]["stamp"][0]) * 1e-9
    late = 0.01 ** 2 + step[:, None, None] ** 2 / 12.0
    assert added == pytest.approx(late * rate[:, :, None] * rate[:, None, :], abs=1e-12)


@pytest.mark.parametrize("method", [{}, PRINTED], ids=["fusion", "as printed"])
def test_reliability_is_the_exponent_of_the_weight(resting, method):
    imu, mag = resting
    larger = MagLog(mag.stamp, np.where(mag.stamp[:, None] > 2e9, 1.1, 1.0) * mag.mag)
    for p in (2.0, 20.0):
        rows = run((imu, larger), {"mag.reliability": p, **method})
        late = rows["stamp"] > 9e9
        # Norms are relative to the first; the filter follows a little.
        assert rows["reliability"][late].mean() == pytest.approx(math.exp(-(0.1 * p) ** 2),
                                                                 abs=0.05)
        if not method:
            assert (((rows["flags"][late] & FLAG_MAG_DISTURBED) != 0).mean() > 0.9) == (p > 10)


def test_latency_beyond_the_bound_is_late(moving):
    imu, mag, _, _ = moving
    for bound, late in ((0.1, 1), (0.3, 0)):
        estimator = make({"mag.max_latency": bound})
        estimator.run(imu, mag)
        estimator.add_mag(int(imu.stamp[-1] - 0.2e9), mag.mag[-1])
        assert estimator.summary()["mag_late"] == late


def test_the_printed_field_wanders_by_its_sd_in_its_time(moving):
    def heading(changes):
        return world_covariances(run(moving, PRINTED | changes))[-1, 2, 2]

    assert heading({"gyro_mag.field_sd": 0.2}) > 2.0 * heading({})
    assert heading({"gyro_mag.field_time": 2.0}) > 1.05 * heading({})


@pytest.mark.parametrize("name, larger, ratio", [
    ("fusion.velocity_walk", 1.0, 1.5), ("fusion.velocity_sd", 6.0, 1.05),
    ("fusion.velocity_time", 3.0, 1.05), ("fusion.position_sd", 6.0, 1.05),
    ("fusion.position_time", 3.0, 1.05)])
def test_less_certain_motion_is_less_certain_tilt(moving, name, larger, ratio):
    def tilt(changes):
        return world_covariances(run(moving[:1] + (None,), changes))[-400:, :2, :2].trace(
            axis1=1, axis2=2).mean()

    assert tilt({name: larger}) > ratio * tilt({})


@pytest.mark.parametrize("name, larger, ratio", [
    ("fusion.field_walk", 3e-2, 1.05), ("fusion.local_field_sd", 0.2, 1.05),
    ("fusion.mag_disturbance_sd", 0.3, 1.05), ("fusion.mag_matrix_sd", 0.2, 1.5),
    ("sensor.mag_noise_sd", 3e-5, 1.05)])
def test_a_less_certain_field_is_a_less_certain_heading(moving, name, larger, ratio):
    def heading(changes):
        return world_covariances(run(moving, {"alignment.heading_anchor": "field", **changes})
                                 )[-400:, 2, 2].mean()

    assert heading({name: larger}) > ratio * heading({})


@pytest.mark.parametrize("name, usual", [("fusion.mag_offset_sd", 0.03),
                                         ("fusion.mag_matrix_sd", 0.02)])
def test_iron_left_over_is_part_of_the_anchored_heading(resting, name, usual):
    variances = [world_covariances(run(resting, {name: sd}))[-1, 2, 2] for sd in (usual, 0.2)]
    horizontal = math.hypot(*earth_field()[:2]) / np.linalg.norm(earth_field())
    assert variances[1] - variances[0] == pytest.approx(
        (0.2 ** 2 - usual ** 2) / horizontal ** 2, rel=0.02)


def test_a_local_field_that_lasts_hides_the_field_of_the_surroundings_for_longer(moving):
    """North is where the surroundings' field points, whatever the place of the start adds."""
    found = [world_covariances(run(moving, {
        "alignment.heading_anchor": "field", "fusion.local_field_sd": 0.2,
        "fusion.local_field_time": time}))[-400:, 2, 2].mean() for time in (0.1, 3.0)]
    assert found[1] > 1.2 * found[0]


def test_a_norm_that_deviates_pulls_less_with_a_larger_factor(moving):
    imu, mag, _, _ = moving
    pulled = mag.mag.copy()
    span = (mag.stamp > mag.stamp[0] + int(6e9)) & (mag.stamp < mag.stamp[0] + int(8e9))
    pulled[span] += [30e-6, 0.0, 0.0]
    off = []
    for factor in (0.0, 10.0):
        changes = {"fusion.norm_deviation_factor": factor}
        rows, clean = run((imu, MagLog(mag.stamp, pulled)), changes), run(moving, changes)
        off.append((Rotation.from_quat(rows["quat_world_imu"]).inv()
                    * Rotation.from_quat(clean["quat_world_imu"])).magnitude().max())
    assert off[1] < 0.5 * off[0]


@pytest.mark.parametrize("name, value", [("fusion.rest_rate", 1e-3), ("fusion.rest_force", 1e-2),
                                         ("fusion.rest_time", 60.0)])
def test_rest_needs_quiet_rates_and_forces_for_a_time(resting, name, value):
    assert still(run(resting, {})) > 0.9
    assert still(run(resting, {name: value})) < 0.1


def test_the_bias_at_rest_is_known_as_well_as_rest_is(resting):
    sds = [run(resting, {"fusion.rest_rate_sd": sd})["gyr_bias_sd"][-1].max()
           for sd in (1e-4, 0.1)]
    assert sds[1] > 1.2 * sds[0]


def test_corrections_come_once_per_block(moving):
    for block in (0.02, 0.1):
        rows = run(moving, {"fusion.block": block})
        changes = (np.diff(rows["gyr_bias"], axis=0) != 0).any(axis=1).sum()
        assert changes == pytest.approx(12.0 / block, rel=0.02)


def test_gaps_are_flagged_above_their_bound_and_widen_by_the_unseen_rate(moving):
    imu, mag, _, _ = moving
    keep = np.r_[0:900, 940:1400]                # 0.205 s without a sample
    logs = imu[keep], mag
    rows = {rate: run(logs, {"gap.rate_sd": rate}) for rate in (0.1, 0.5)}
    assert list(np.flatnonzero(rows[0.1]["flags"] & FLAG_GAP)) == [900]
    assert np.trace(rows[0.5]["cov_attitude"][900]) > np.trace(rows[0.1]["cov_attitude"][900])
    # Without a correction in the same row it is all there.
    alone = [world_covariances(run((logs[0], None), PRINTED | {"gap.rate_sd": rate}))[900]
             for rate in (0.1, 0.5)]
    assert alone[1] - alone[0] == pytest.approx(0.24 * 0.205 ** 2 * np.eye(3), abs=1e-9)
    assert not (run(logs, {"gap.max": 0.3})["flags"] & FLAG_GAP).any()
    anew = run(logs, {"gap.restart": 0.2})["flags"]
    assert anew[900] & FLAG_GAP and anew[900] & FLAG_ALIGNING
    assert not (rows[0.1]["flags"][300:] & FLAG_ALIGNING).any()


@pytest.mark.parametrize("values, text", [
    ({"gyro_mag.field_sd": 0.1}, "'gyro_mag.field_sd': does nothing with method 'fusion'"),
    ({"gyro_mag.as_printed": True}, "'gyro_mag.as_printed': does nothing with method 'fusion'"),
    ({"method": "gyro_mag", "fusion.use_acc": False}, "does nothing with method 'gyro_mag'"),
    ({"method": "gyro_mag", "fusion.velocity_sd": 1.0}, "does nothing with method 'gyro_mag'"),
    ({"method": "gyro_mag", "mode": "smoothed"}, "'mode': does nothing with method 'gyro_mag'"),
    ({"method": "gyro_mag", "gyro_mag.field_time": 1.0}, "nothing without gyro_mag.as_printed"),
    (PRINTED | {"fusion.block": 0.1}, "'fusion.block': does nothing with gyro_mag.as_printed"),
    (PRINTED | {"sensor.gyro_scale_sd": 0.1}, "does nothing with gyro_mag.as_printed"),
    ({"mode": "smoothed", "lag": 1.0}, "'lag': does nothing with mode 'smoothed'"),
    ({"fusion": {"use_acc": False, "position_sd": 1.0}}, "does nothing without fusion.use_acc"),
    ({"sensor": {"mag_delay": 0.01, "mag_delay_sd": 0.1}}, "with sensor.mag_delay given"),
    ({"sensor": {"gyro_delay": 0.01, "gyro_delay_sd": 0.1}}, "with sensor.gyro_delay given"),
    ({"lag": 0.0}, "'lag': 0.0 is out of bounds"),
    ({"mag_sd": 0.1}, "'mag_sd' is called 'fusion.mag_disturbance_sd' now"),
    ({"surge_time": 0.1}, "'surge_time' is called 'fusion.angular_acc_time' now"),
    ({"estimate_bias": False}, "'fusion.estimate_bias' or, .* 'gyro_mag.as_printed' now"),
])
def test_what_does_nothing_and_old_names_are_refused(values, text):
    with pytest.raises(ParameterError, match=text):
        OrientationParams.from_mapping(values)


def test_old_names_lead_to_new_ones():
    known = {info.name for info in OrientationParams.infos()}
    for old, new in OrientationParams.OLD_NAMES.items():
        assert old not in known
        assert set(re.findall(r"[a-z_]+\.[a-z_]+", new)) & known, old


def test_what_does_nothing_leaves_the_estimate_as_it_is(moving):
    """The claims of idle() on the kernel's own record: other values, the same rows."""
    for values, names in (
            ({"method": "gyro_mag"}, ("velocity_walk", "velocity_sd", "velocity_time",
                                      "position_sd", "position_time")),
            ({"fusion.use_acc": False}, ("velocity_walk", "velocity_sd", "velocity_time",
                                         "position_sd", "position_time"))):
        estimator = make(values)
        first = estimator.run(*moving[:2])
        other = make(values)
        for name in names:
            other._par["fusion"][name] *= 3.0
        rows = other.run(*moving[:2])
        for name in rows.dtype.names:
            assert np.array_equal(rows[name], first[name],
                                  equal_nan=rows[name].dtype.kind == "f"), name


def test_the_record_has_what_follows_from_the_parameters():
    p = kernel_parameters(OrientationParams.from_mapping(
        {"declination_deg": 10.0, "sensor.mag_delay": 0.01, "world_frame": "ned"}))[0]
    assert p["declination"] == pytest.approx(math.radians(10.0))
    assert (p["mag_delay_sd"], p["gyro_delay"], p["gyro_delay_sd"]) == (0.0, 0.0, 0.004)
    assert Rotation.from_quat(p["frame_from_enu"]).apply([1, 2, 3]) == pytest.approx([2, 1, -3])
    with_gyro_mag = kernel_parameters(OrientationParams(method="gyro_mag"))[0]
    assert not with_gyro_mag["use_acc"] and with_gyro_mag["rest_force"] == math.inf
