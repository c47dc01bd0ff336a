"""The orientation estimator's shell: rows, splitting, bad input, initial orientation."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.alignment import triad
from imu_fusion.estimation.orientation.estimator import (
    ORIENTATION_DTYPE,
    OrientationEstimator,
    OrientationParams,
)
from imu_fusion.estimation.orientation.rows import FLAG_ALIGNING, FLAG_GAP
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, earth_field, simulate

NOISY = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005))


def make(changes):
    """An estimator whose parameters differ from the defaults by ``changes``, dotted names."""
    return OrientationEstimator(OrientationParams.from_mapping(changes))


def errors_deg(rows, truth):
    """Angle between estimate and truth per row."""
    error = Rotation.from_quat(rows["quat_world_imu"]).inv() * Rotation.from_quat(truth)
    return np.degrees(error.magnitude())


@pytest.fixture(scope="module", params=[
    dict(method="gyro_mag"), {"method": "gyro_mag", "gyro_mag.as_printed": True},
    dict(method="fusion")],
    ids=["gyro_mag", "as printed", "fusion"])
def params(request):
    return OrientationParams.from_mapping(request.param)


@pytest.fixture(scope="module")
def recording():
    return simulate(Tumbling(seed=1), 12.0, rate=200.0, mag_rate=50.0, sensors=NOISY, seed=2)


def feed(estimator, imu, mag):
    """Sample by sample, in merge order."""
    events = sorted([(s, 0, i) for i, s in enumerate(mag.stamp)]
                    + [(s, 1, i) for i, s in enumerate(imu.stamp)])
    parts = [estimator.add_imu(int(s), imu.gyr[i], imu.acc[i]) if kind
             else estimator.add_mag(int(s), mag.mag[i]) for s, kind, i in events]
    return np.concatenate([*parts, estimator.finish()])


def test_stream_equals_batch_bit_for_bit(params, recording):
    imu, mag, _, _ = recording
    batch = OrientationEstimator(params).run(imu, mag)
    assert len(batch) == len(imu)
    assert feed(OrientationEstimator(params), imu, mag).tobytes() == batch.tobytes()


@pytest.mark.parametrize("cut", [37, 199, 200, 201, 1203])
def test_splitting_changes_nothing(params, recording, cut):
    imu, mag, _, _ = recording
    whole = OrientationEstimator(params).run(imu, mag)
    border = imu.stamp[cut]
    first = OrientationEstimator(params)
    rows = first.run(imu[:cut], mag[mag.stamp < border])
    second = OrientationEstimator(params)
    second.set_state(first.get_state())
    rest = second.run(imu[cut:], mag[mag.stamp >= border])
    assert np.concatenate([rows, rest]).tobytes() == whole.tobytes()


def test_reset_forgets(params, recording):
    imu, mag, _, _ = recording
    estimator = OrientationEstimator(params)
    first = estimator.run(imu, mag)
    estimator.reset()
    assert estimator.run(imu, mag).tobytes() == first.tobytes()


def test_recording_shorter_than_the_alignment(params, recording):
    imu, mag, _, _ = recording
    estimator = OrientationEstimator(params)
    assert len(estimator.run(imu[:50], mag[:12])) == 0
    rows = estimator.finish()
    assert len(rows) == 50
    assert (rows["flags"] & FLAG_ALIGNING).all()


def test_bad_samples_are_dropped_and_counted(params, recording):
    imu, mag, _, _ = recording
    clean = OrientationEstimator(params)
    dirty = OrientationEstimator(params)
    for i in range(600):
        a = clean.add_imu(int(imu.stamp[i]), imu.gyr[i], imu.acc[i])
        b = dirty.add_imu(int(imu.stamp[i]), imu.gyr[i], imu.acc[i])
        assert a.tobytes() == b.tobytes()
        assert len(dirty.add_imu(int(imu.stamp[i]) + 1, [math.nan, 0, 0], imu.acc[i])) == 0
        assert len(dirty.add_imu(int(imu.stamp[i]) + 1, imu.gyr[i], [0, math.inf, 0])) == 0
        assert len(dirty.add_imu(int(imu.stamp[i]), imu.gyr[i], imu.acc[i])) == 0
        assert len(dirty.add_mag(int(imu.stamp[i]), [0, math.nan, 0])) == 0
    assert dirty.summary()["imu_rejected"] == 3 * 600
    assert dirty.summary()["mag_rejected"] == 600


def test_a_gap_is_flagged_and_enlarges_the_covariance(params, recording):
    imu, mag, _, _ = recording
    keep = np.r_[0:900, 1000:1400]
    estimator = OrientationEstimator(params)
    rows = estimator.run(imu[keep], mag)
    flagged = np.flatnonzero(rows["flags"] & FLAG_GAP)
    assert list(flagged) == [900]
    assert estimator.summary()["gaps"] == 1
    before, after = (np.trace(rows["cov_attitude"][i]) for i in (899, 900))
    # 0.5 s without rates: the default lets 1 rad/s go unseen, 0.5 rad per axis.
    assert after > before + 3 * 0.2 ** 2
    assert np.isfinite(rows["quat_world_imu"]).all()


def test_late_magnetometer_samples_count_at_their_own_time(params, recording):
    imu, mag, truth, _ = recording
    lag = int(0.05e9)
    estimator = OrientationEstimator(params)
    events = sorted([(s + lag, 0, i) for i, s in enumerate(mag.stamp)]
                    + [(s, 1, i) for i, s in enumerate(imu.stamp)])
    parts = [estimator.add_imu(int(s), imu.gyr[i], imu.acc[i]) if kind
             else estimator.add_mag(int(mag.stamp[i]), mag.mag[i]) for s, kind, i in events]
    rows = np.concatenate(parts)
    on_time = OrientationEstimator(params).run(imu, mag)
    late_error = errors_deg(rows, truth.quat_world_imu).max()
    assert late_error < errors_deg(on_time, truth.quat_world_imu).max() + 0.5
    assert len(estimator.add_mag(int(imu.stamp[-1] - 0.2e9), mag.mag[-1])) == 0
    assert estimator.summary()["mag_late"] == 1


def test_triad_has_world_axes_as_rows_and_the_sign_of_the_declination():
    # Declination 10 deg east: the needle points 10 deg east of north. Level, x to the east.
    field = earth_field(declination=math.radians(10.0))
    r = triad(np.array([0.0, 0.0, 9.8]), field, math.radians(10.0))
    assert r == pytest.approx(np.eye(3), abs=1e-12)
    turn = Rotation.from_euler("ZYX", [0.4, -0.9, 2.2])   # world from imu
    r = triad(turn.inv().apply([0, 0, 9.8]), turn.inv().apply(field), math.radians(10.0))
    assert r == pytest.approx(turn.as_matrix(), abs=1e-12)


@pytest.mark.parametrize("inclination_deg", [65.0, -60.0, 0.0])
@pytest.mark.parametrize("declination_deg", [-30.0, 0.0, 30.0])
def test_initial_orientation_in_any_attitude(inclination_deg, declination_deg):
    field = earth_field(inclination=math.radians(inclination_deg),
                        declination=math.radians(declination_deg))
    for seed in range(4):
        imu, mag, truth, _ = simulate(Tumbling(seed=seed, rest=10.0), 1.5, field_world=field)
        estimator = OrientationEstimator(OrientationParams(declination_deg=declination_deg))
        rows = estimator.run(imu, mag)
        assert errors_deg(rows, truth.quat_world_imu).max() < 1e-5
        assert estimator.summary()["inclination_deg"] == pytest.approx(inclination_deg)


def test_world_frames_are_the_same_attitude(recording):
    imu, mag, _, _ = recording
    rows = {frame: OrientationEstimator(OrientationParams(world_frame=frame)).run(
        imu[:600], mag[:150]) for frame in ("enu", "ned", "nwu")}
    v = [1.0, 2.0, 3.0]
    enu, ned, nwu = (Rotation.from_quat(rows[f]["quat_world_imu"]).apply(v)
                     for f in ("enu", "ned", "nwu"))
    assert ned == pytest.approx(np.column_stack([enu[:, 1], enu[:, 0], -enu[:, 2]]))
    assert nwu == pytest.approx(np.column_stack([enu[:, 1], -enu[:, 0], enu[:, 2]]))
    b = {f: np.nanmean(rows[f]["mag_world"], axis=0) for f in rows}
    assert b["enu"][2] < 0 < b["ned"][2]


def test_rows_have_the_promised_layout(params, recording):
    imu, mag, _, _ = recording
    rows = OrientationEstimator(params).run(imu[:400], mag)
    assert rows.dtype == ORIENTATION_DTYPE
    assert (rows["stamp"] == imu.stamp[:400]).all()
    assert np.linalg.norm(rows["quat_world_imu"], axis=1) == pytest.approx(np.ones(400))
    for name in ("cov_attitude", "cov_gyr", "cov_acc"):
        assert (np.linalg.eigvalsh(rows[name]) > 0).all(), name
    with_mag = np.isfinite(rows["reliability"])
    assert (with_mag == np.isfinite(rows["mag_world"]).all(axis=1)).all()
    assert with_mag.sum() == pytest.approx(100, abs=2)   # 50 Hz beside 200 Hz


def test_parameters_are_refused_by_name():
    with pytest.raises(ParameterError, match="gyro_range"):
        OrientationParams.from_mapping({"sensor.gyro_range": (1.0, 2.0)})


def test_a_delay_that_is_not_given_is_part_of_the_covariance_while_turning():
    """Rates that are 4 ms late: no estimator can tell, but it can say so."""
    imu, mag, truth, _ = simulate(Tumbling(seed=1, rate_sd=3.0), 20.0, rate=200.0, sensors=NOISY,
                                  seed=2)
    later = int(4e6)
    imu = ImuLog(imu.stamp + later, imu.gyr, imu.acc)
    mag = MagLog(mag.stamp + later, mag.mag)
    shares = {}
    for name, changes in (("unset", {}), ("wrong", {"sensor.gyro_delay": 0.0}),
                          ("given", {"sensor.gyro_delay": 0.004})):
        rows = make({"sensor.axes_sd": 1e-3, "fusion.gyro_factor": 1.0, **changes}).run(imu, mag)
        want = simulate(Tumbling(seed=1, rate_sd=3.0), 20.0, rate=200.0, seed=2)[2]
        want = Rotation.from_quat(want.quat_world_imu) * Rotation.from_rotvec(0.004 * rows["gyr"])
        error = (Rotation.from_quat(rows["quat_world_imu"]).inv() * want).as_rotvec()
        fast = np.linalg.norm(rows["gyr"], axis=1) > 4.0
        distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_attitude"]), error)
        shares[name] = (distance[fast] < 14.16).mean()    # 3 sigma of three degrees of freedom
    assert shares["unset"] > 0.99 and shares["given"] > 0.99 and shares["wrong"] < 0.9


@pytest.mark.parametrize("norm, least, most", [(9.83, 0.2, 0.6), (10.10, 1.0, 2.5)])
def test_a_force_that_is_not_gravitys_size_at_rest_doubts_the_vertical(norm, least, most):
    """0.3 m/s^2 of bias along up are as likely across: 1.7 deg."""
    stamp = np.arange(300, dtype=np.int64) * 10_000_000
    rows = make({}).run(ImuLog(stamp, np.zeros((300, 3)), np.tile([0.0, 0.0, norm], (300, 1))))
    tilt = np.degrees(np.sqrt(rows["cov_attitude"][-1, 0, 0]))
    assert least < tilt < most
