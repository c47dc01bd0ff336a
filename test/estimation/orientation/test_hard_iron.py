"""A magnetometer that nobody has calibrated: hard iron as strong as the field."""

from dataclasses import replace

import numpy as np
import pytest

from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Tumbling, simulate
from test.estimation.orientation.errors import local_errors
from test.estimation.orientation.ordinary import ORDINARY
from test.estimation.orientation.test_estimator import feed, make

IRON = np.array([30e-6, -15e-6, 20e-6])


def recording(iron=IRON, rest=3.0, duration=60.0, seed=3):
    motion = Tumbling(seed=seed, rate_sd=1.0, rest=rest)
    return simulate(motion, duration, rate=100.0, seed=seed,
                    sensors=replace(ORDINARY, mag_offset=tuple(iron)))[:3]


@pytest.fixture(scope="module")
def magnetised():
    return recording()


def headings_deg(rows, truth):
    return np.degrees(np.linalg.norm(local_errors(rows, truth), axis=1))


def within(rows, truth):
    error = local_errors(rows, truth)
    return (np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_attitude"]), error)
            < 14.156).mean()


def iron_of(estimator):
    return estimator.get_state()["state"]["hard_iron"][0]


def test_the_whole_recording_shows_it_and_it_is_taken_off(magnetised):
    imu, mag, truth = magnetised
    estimator = make({"mode": "smoothed"})
    rows = estimator.run(imu, mag)
    assert np.abs(iron_of(estimator)["offset"] - IRON).max() < 1e-6
    assert headings_deg(rows, truth).max() < 4.0
    assert within(rows, truth) > 0.99
    assert "30, -15, 20 uT" in estimator.remarks()[0] and "taken off" in estimator.remarks()[0]


def test_a_start_in_motion_is_no_obstacle():
    imu, mag, truth = recording(rest=0.0)
    estimator = make({"mode": "smoothed"})
    rows = estimator.run(imu, mag)
    assert np.abs(iron_of(estimator)["offset"] - IRON).max() < 2e-6
    assert headings_deg(rows, truth)[500:].max() < 8.0


def test_live_it_is_said_and_stated(magnetised):
    imu, mag, truth = magnetised
    estimator = make({})
    rows = estimator.run(imu, mag)
    assert "after the start" in estimator.remarks()[0]
    found = rows["stamp"] > imu.stamp[0] + 15_000_000_000
    assert within(rows[found], truth[found]) > 0.95
    assert feed(make({}), imu, mag).tobytes() == rows.tobytes()


def test_after_a_gap_that_makes_it_start_anew_live_takes_it_off(magnetised):
    imu, mag, truth = magnetised
    kept = (imu.stamp < imu.stamp[0] + 40_000_000_000) | (imu.stamp > imu.stamp[0] + 43_000_000_000)
    imu = ImuLog(imu.stamp[kept], imu.gyr[kept], imu.acc[kept])
    estimator = make({})
    rows = estimator.run(imu, mag)
    late = imu.stamp > imu.stamp[0] + 50_000_000_000
    assert np.abs(iron_of(estimator)["taken_off"] - IRON).max() < 2e-6
    assert headings_deg(rows, truth[kept])[late].max() < 15.0


def test_what_a_calibration_leaves_over_is_no_iron():
    imu, mag, _ = recording(iron=(1.5e-6, -1.5e-6, 0.0))
    for mode in ("causal", "smoothed"):
        estimator = make({"mode": mode})
        estimator.run(imu, mag)
        assert estimator.remarks() == [] and not iron_of(estimator)["found"]


def test_a_field_that_differs_from_place_to_place_is_no_iron(magnetised):
    imu, _, truth = magnetised
    clean = recording(iron=np.zeros(3))[1]
    rng = np.random.default_rng(0)
    time = (clean.stamp - clean.stamp[0]) * 1e-9
    places = sum(a * np.sin(w * time[:, None] + b) for a, w, b in zip(
        rng.normal(0, 5e-6, (6, 3)), rng.uniform(0.2, 3.0, (6, 1)), rng.uniform(0, 6, (6, 3))))
    estimator = make({"mode": "smoothed"})
    estimator.run(imu, MagLog(clean.stamp, clean.mag + places))
    assert not iron_of(estimator)["found"]


def test_a_lost_magnetometer_says_nothing(magnetised):
    imu = magnetised[0]
    estimator = make({"mode": "smoothed"})
    estimator.run(imu)
    assert estimator.remarks() == [] and iron_of(estimator)["windows"] == 0


def test_stated_iron_is_left_to_the_filter(magnetised):
    imu, mag, _ = magnetised
    estimator = make({"mode": "smoothed", "sensor.mag_offset": tuple(IRON)})
    estimator.run(imu, mag)
    assert estimator.remarks() == []
