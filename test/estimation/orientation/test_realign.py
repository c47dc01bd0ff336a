"""A rest that the filter does not believe in: rates and forces that stand still, and what turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.rows import FLAG_STILL
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.going_round import Circles
from imu_fusion.simulation.rotation import GRAVITY, Sensors, Tumbling, simulate
from test.estimation.orientation.errors import local_errors, tilt_errors_deg
from test.estimation.orientation.test_estimator import feed, make

LENGTH = 30.0
BIAS = np.array([0.12, -0.05, 0.03])


class _ComingToRest:
    """A tumbling body run backwards: 8 s of rest end it."""

    forwards = Tumbling(seed=2, rest=8.0)

    def truth(self, t):
        quat, rate, position, acceleration = self.forwards.truth(LENGTH - np.asarray(t))
        return quat, -rate, position, acceleration


@pytest.fixture(scope="module")
def coming_to_rest():
    sensors = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=tuple(BIAS))
    return simulate(_ComingToRest(), LENGTH, rate=100.0, sensors=sensors, seed=1)


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_rest_refutes_a_bias_that_was_thought_to_be_known(coming_to_rest, mode):
    """12 sd of what is stated: in motion the filter ends far from it, and sure of that."""
    imu, _, truth, _ = coming_to_rest
    estimator = make({"mode": mode, "fusion.gyro_factor": 1.0, "fusion.lasting_acc_sd": 0.0})
    rows = estimator.run(imu)
    assert estimator.summary()["realigned"] == 1
    assert "stood still" in estimator.remarks()[0]
    # It takes seconds to show: the smoother knows it from the beginning of the rest on.
    rest = LENGTH - _ComingToRest.forwards.rest
    begun = (imu.stamp > int((rest + 1.0) * 1e9)) & (imu.stamp < int((rest + 1.5) * 1e9))
    assert mode == "causal" or tilt_errors_deg(rows, truth)[begun].max() < 2.0
    late = imu.stamp > int((LENGTH - 3.0) * 1e9)
    assert (rows["flags"][late] & FLAG_STILL).all()
    tilt = tilt_errors_deg(rows, truth)[late]
    assert tilt.max() < 1.0
    # About the vertical nothing but the rest itself tells the bias.
    assert np.abs(rows["gyr_bias"][-1] - BIAS).max() < 0.005
    turn = Rotation.from_quat(rows["quat_world_imu"][late]).as_matrix()
    error = np.einsum("nij,nj->ni", turn, local_errors(rows, truth)[late])[:, :2]
    cov = (turn @ rows["cov_attitude"][late] @ turn.transpose(0, 2, 1))[:, :2, :2]
    assert (np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error) < 11.83).all()


def test_sample_by_sample_it_is_the_same(coming_to_rest):
    imu, mag, _, _ = coming_to_rest
    changes = {"fusion.gyro_factor": 1.0}
    batch = make(changes).run(imu, mag)
    assert feed(make(changes), imu, mag).tobytes() == batch.tobytes()


def _steady(rate, force_of):
    """At 100 Hz, 60 s of a steady rate (3,) after 5 s of rest; force_of: turns (n, 3) to (n, 3)."""
    time = np.arange(0.0, 65.0, 0.01)
    moving = np.clip(time - 5.0, 0.0, None)[:, None] * rate
    rng = np.random.default_rng(0)
    gyr = (time > 5.0)[:, None] * rate + rng.normal(0, 2e-3, (len(time), 3))
    acc = force_of(moving) + rng.normal(0, 0.02, (len(time), 3))
    return ImuLog((time * 1e9).astype(np.int64), gyr, acc)


@pytest.mark.parametrize("rate", [
    [0.0, 0.0, 0.05], [0.03, 0.0, 0.0], [0.03, 0.0, 0.03], [0.01, 0.0, 0.05]])
def test_a_slow_turn_is_no_rest(rate):
    """About the vertical the force stands still, about any other axis it does not."""
    rate = np.array(rate)
    up = [0.0, 0.0, GRAVITY]
    imu = _steady(rate, lambda turned: Rotation.from_rotvec(turned).inv().apply(up))
    estimator = OrientationEstimator()
    rows = estimator.run(imu)
    assert estimator.summary()["realigned"] == 0 and estimator.remarks() == []
    truth = Rotation.from_rotvec(np.clip(imu.stamp[:, None] * 1e-9 - 5.0, 0.0, None) * rate)
    error = Rotation.from_quat(rows["quat_world_imu"]).inv() * truth
    error = (error * error[400].inv()).magnitude()
    assert np.degrees(error[-1]) < 6.0


@pytest.mark.parametrize("leans", [False, True])
def test_a_circle_is_no_rest(leans):
    """The force of a body that goes round stands still, and its rate points away from it."""
    imu, _, _, _ = simulate(Circles(1, 20.0, 0.2, leans, sway=0.0), 40.0, rate=100.0, seed=1,
                            sensors=Sensors(gyr_density=1e-4, acc_density=2e-3))
    estimator = OrientationEstimator()
    rows = estimator.run(imu)
    assert estimator.summary()["realigned"] == 0
    assert not (rows["flags"][imu.stamp > int(10e9)] & FLAG_STILL).any()


def test_a_body_that_feels_no_force_refutes_nothing():
    """Steady rates and forces, as at rest, but no gravity: an array that spins."""
    n = 200
    imu = ImuLog(10_000_000 * np.arange(n), gyr=np.tile([0.0, 0.0, 5.0], (n, 1)),
                 acc=np.zeros((n, 3)))
    estimator = make({})
    assert len(estimator.run(imu)) == n
    assert estimator.summary()["realigned"] == 0


def test_the_smoother_knows_a_rest_from_its_beginning(coming_to_rest):
    """Live it takes seconds of it to tell that the bias was wrong."""
    imu, _, truth, _ = coming_to_rest
    begun = (imu.stamp > int((LENGTH - 6.0) * 1e9)) & (imu.stamp < int((LENGTH - 5.5) * 1e9))
    changes = {"fusion.gyro_factor": 1.0, "fusion.lasting_acc_sd": 0.0}
    tilt = {mode: tilt_errors_deg(make({"mode": mode, **changes}).run(imu), truth)[begun]
            for mode in ("causal", "smoothed")}
    assert tilt["causal"].min() > 5.0 and tilt["smoothed"].max() < 2.0
