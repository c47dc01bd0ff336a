"""Rates beyond the gyroscope's range in the fusion filter."""

import numpy as np
import pytest

from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.gyro_limit import limits_of
from imu_fusion.estimation.orientation.params import kernel_parameters
from imu_fusion.estimation.orientation.rows import FLAG_SATURATED
from imu_fusion.samples.logs import ImuLog
from imu_fusion.sensors.saturation import saturated_axes
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from test.estimation.orientation.errors import local_errors, rmse_deg
from test.estimation.orientation.test_estimator import make


@pytest.mark.parametrize("rate", [20.0, 200.0, 1000.0])
@pytest.mark.parametrize("limit", [1.5, 4.0])
def test_start_in_motion_at_the_limit(rate, limit):
    """No sample of the first second may be trusted whole, and a gap follows."""
    sensors = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_limit=limit)
    imu, mag, truth, rates = simulate(Tumbling(seed=3, rate_sd=3.0), 20.0, rate=rate,
                                      sensors=sensors, seed=1)
    keep = np.arange(len(imu)) >= 7 * rate
    keep[int(13 * rate):int(13.2 * rate)] = False
    at = (np.abs(imu.gyr) >= limit)[keep]
    assert at[:int(rate)].any()
    for mode in ("causal", "smoothed"):
        # Magnetometer samples of before the first Imu sample tell nothing of the present.
        rows = make({"mode": mode, "sensor.gyro_range": (limit,)}).run(
            imu[keep], mag)
        error = local_errors(rows, truth[keep])
        assert np.linalg.eigvalsh(rows["cov_attitude"]).min() > 0.0
        squared = np.einsum("ni,ni->n", error, np.linalg.solve(
            rows["cov_attitude"], error[..., None])[..., 0])
        sd = np.sqrt(np.diagonal(rows["cov_gyr"], axis1=1, axis2=2))
        beyond = (np.abs(rows["gyr"] - rates[keep]) > 3.0 * sd)[at]
        # Ideal 3 and 0.003. At 20 Hz the rate changes by 0.5 rad/s between samples.
        assert squared.mean() < (8.0 if rate < 50 else 4.0) and beyond.mean() < 0.005
        # An axis is at its limit in 93 % and 49 % of the samples. With clipped rates taken for
        # true in the first second, and the field of before it: 40 to 120 deg.
        bound = {"causal": 35.0, "smoothed": 25.0} if limit < 2 else {"causal": 20.0,
                                                                      "smoothed": 8.0}
        assert rmse_deg(rows, truth[keep]) < bound[mode]


def test_bursts_beyond_the_limit_are_solved():
    fast = Tumbling(seed=21, rate_sd=5.0)
    sensors = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_limit=6.0)
    imu, mag, truth, rates = simulate(fast, 25.0, rate=200.0, sensors=sensors, seed=2)
    clipped = np.abs(imu.gyr) >= 6.0
    before = np.sqrt(((imu.gyr - rates)[clipped] ** 2).mean())
    result = {}
    for mode in ("causal", "smoothed"):
        estimator = OrientationEstimator(OrientationParams(mode=mode))
        result[mode] = estimator.run(imu, mag)
        # The limit was not given: it is found from the first flat top.
        assert estimator.summary()["saturated"] > 0.9 * clipped.any(axis=1).sum()
    flagged = (result["causal"]["flags"] & FLAG_SATURATED) != 0
    assert not flagged[~saturated_axes(imu.gyr, 6.0).any(axis=1)].any()
    after = np.sqrt(((result["smoothed"]["gyr"] - rates)[clipped] ** 2).mean())
    assert after < 0.2 * before
    # Beside the same filter that takes clipped rates for true ones.
    blind = make({"sensor.gyro_range": (1e3,)}).run(imu, mag)
    assert rmse_deg(result["causal"], truth) < 0.4 * rmse_deg(blind, truth)
    assert rmse_deg(result["smoothed"], truth) < 0.4 * rmse_deg(result["causal"], truth)


def test_one_wild_rate_does_not_hide_the_limit_and_both_ends_of_a_range_count():
    """A range of 16 bits ends at -32768 and +32767."""
    imu, mag, truth, _ = simulate(Tumbling(seed=21, rate_sd=5.0), 25.0, rate=200.0, seed=2,
                                  sensors=Sensors(gyr_density=2e-4, gyr_limit=6.0))
    gyr = np.minimum(imu.gyr, 6.0 * 32767 / 32768)
    at_limit = np.abs(gyr) > 5.999
    gyr[100, :] = 500.0
    rows = OrientationEstimator().run(ImuLog(imu.stamp, gyr, imu.acc), mag)
    flagged = (rows["flags"] & FLAG_SATURATED) != 0
    # What comes before the fourth sample of the first flat top of each axis is not known.
    assert flagged[at_limit.any(axis=1)][100:].all()
    assert not flagged[~at_limit.any(axis=1)].any()


def mixed_and_noisy(rates, rng):
    """Rates (n, 3) as a gyroscope clips them at RANGE and a calibration mixes them afterwards."""
    calibration = np.eye(3) + 0.003 * rng.standard_normal((3, 3))
    return np.clip(rates + 0.005 * rng.standard_normal(rates.shape), -6.0, 6.0) @ calibration.T


def limits(gyr):
    return limits_of(gyr, kernel_parameters(OrientationParams()))["limit"][0]


@pytest.mark.parametrize("times", [1, 2])
def test_a_top_that_is_reached_slowly_is_found(times):
    """At 200 Hz, by steps as small as those that misalignment leaves of it, and perhaps once."""
    time, rng = np.arange(2000 * times) / 200.0, np.random.default_rng(1)
    bumps = sum(np.exp(-0.5 * ((time - 5.0 - 10.0 * k) / 0.7) ** 2) for k in range(times))
    rates = np.column_stack([8.0 * bumps, 3.0 * np.sin(2.0 * time), 2.0 * np.sin(3.3 * time)])
    found = limits(mixed_and_noisy(rates, rng))
    assert found[0] == pytest.approx(6.0, rel=0.02)
    assert np.isinf(found[1:]).all()
    # The same rates within the range: a peak, with the noise of one.
    assert np.isinf(limits(mixed_and_noisy(0.7 * rates, rng))).all()


def test_a_turn_at_a_constant_rate_is_no_top():
    """Its noise goes on; neither do equal values of a coarse converter count."""
    time, rng = np.arange(2000) / 200.0, np.random.default_rng(1)
    yaw = 4.0 * np.clip(np.minimum(time - 2.0, 8.0 - time) / 0.3, 0.0, 1.0)
    rates = np.column_stack([np.sin(2.0 * time), 0.5 * np.sin(3.3 * time), yaw])
    noisy = rates + 0.005 * rng.standard_normal(rates.shape)
    assert np.isinf(limits(noisy)).all()
    assert np.isinf(limits(0.01 * np.round(noisy / 0.01))).all()
