"""Parameters of the acceleration field: refused where they do nothing, and each one matters."""

import numpy as np
import pytest

from imu_fusion.errors import EstimationError, LayoutError, ParameterError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Sensor,
    parse_configuration,
)
from imu_fusion.estimation.acceleration_field.sensor_array import make_sensor_array
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

ARRAY = {"accelerometers": {
    "names": ["a", "b", "c"], "a": {"position": [0, 0, 0]}, "b": {"position": [0.1, 0, 0]},
    "c": {"position": [0, 0.1, 0], "reports": "specific_force"}}}
GYRO = {"use_gyro": True}


def test_configuration_from_a_mapping():
    params, accelerometers = parse_configuration(
        {**ARRAY, **GYRO, "sensor": {"gyro_range": 17.0}})
    assert list(accelerometers) == ["a", "b", "c"] and params.sensor.gyro_range == (17.0,)
    assert accelerometers["b"].position == (0.1, 0.0, 0.0)
    AccelerationFieldEstimator(params, accelerometers)


@pytest.mark.parametrize("values, text", [
    ({"accelerometers.a.noise_densty": 1.0}, "noise_densty"),
    ({"accelerometers.d.range": 1.0}, "accelerometers.d"),
    ({"max_gap": 1.0}, "'max_gap' is called 'gap.max' now"),
    ({"smoother.iterations": 3}, "'smoother.iterations' is called 'iteration.max' now"),
    ({"gyroscope.range": 17.0}, "'gyroscope.range' is called 'sensor.gyro_range' now"),
    ({"gap.max": 0.0}, "'gap.max'.*out of bounds"),
    ({"sensor.gyro_range": 17.0}, r"'sensor.gyro_range'.*without a gyroscope \(use_gyro: true\)"),
    ({"method": "ao", **GYRO}, "'use_gyro': does nothing with method 'ao'"),
    ({"method": "ao", "mode": "smoothed"}, "'mode': does nothing with method 'ao'"),
    ({"method": "ao", "motion.rate": 1.0}, "'motion.rate': does nothing with method 'ao'"),
    ({"method": "sqrt_ao", "accelerometers.b.bias_walk": 1.0}, "'accelerometers.b.bias_walk'"),
    ({"integration": "high_order"}, "'integration': does nothing with method 'rigid_body'"),
    ({"iteration.max": 7}, "'iteration.max': does nothing with mode 'causal'"),
    ({"initial.orientation_sd": 0.1}, "does nothing with initial.mode 'rest'"),
    ({"initial.mode": "given", "initial.duration": 3.0}, "does nothing with initial.mode 'given'"),
])
def test_what_is_wrong_or_does_nothing_is_refused_by_name(values, text):
    with pytest.raises(ParameterError, match=text):
        parse_configuration({**ARRAY, **values})


def test_one_name_twice_is_refused():
    with pytest.raises(LayoutError, match="twice"):
        parse_configuration({"accelerometers": {"names": ["a", "a"]}})


def test_what_an_accelerometer_leaves_unset_is_that_of_all():
    common = Sensor(acc_noise_density=0.1, acc_range=(20.0, 30.0, 40.0), acc_bias_sd=0.3,
                    acc_bias_walk=0.4)
    own = AccelerometerParams(noise_density=0.2, range=(50.0,), bias_sd=0.0, bias_walk=0.6)
    channels = make_sensor_array([AccelerometerParams(), own], common).channels
    assert channels["density"].tolist() == [0.1] * 3 + [0.2] * 3
    assert channels["range"].tolist() == [20.0, 30.0, 40.0] + [50.0] * 3
    assert channels["bias_sd"].tolist() == [0.3] * 3 + [0.0] * 3
    assert channels["bias_walk"].tolist() == [0.4] * 3 + [0.6] * 3


@pytest.fixture(scope="module")
def motion():
    """A body that falls, hits the ground and bounces."""
    return simulate(duration=0.6)


def rows(motion, change, **parameters):
    """Rows of the paper's four accelerometers and a gyroscope with noise, 0.2 s still and on."""
    rng = np.random.default_rng(0)
    still = np.einsum("kij,j->ki", PAPER_AXES, [0.5, 0.0, 9.8])
    readings = np.concatenate([np.broadcast_to(still, (200, 4, 3)),
                               motion.readings(PAPER_POSITIONS, PAPER_AXES)])
    readings = readings + rng.normal(0, 0.05, readings.shape)
    gyr = np.concatenate([np.zeros((200, 3)), motion.omega])
    gyr = gyr + rng.normal(0, 0.02, gyr.shape)
    params = AccelerationFieldParams.from_mapping({
        "initial.duration": 0.1, "sensor.acc_noise_density": 1e-3, **parameters, **change})
    sensors = [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()))
               for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]
    stamp = np.arange(len(readings)) * 1_000_000
    return AccelerationFieldEstimator(params, sensors).run(
        stamp, readings, gyr if params.use_gyro else None)


@pytest.mark.parametrize("change, with_", [
    ({"sensor.acc_bias_walk": 1.0}, {}),
    ({"sensor.acc_range": [30.0]}, {}),
    ({"sensor.gyro_axes": [0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]}, GYRO),
    ({"sensor.gyro_bias_sd": 0.5}, GYRO),
    ({"sensor.acc_scale_sd": 0.1}, {}),
    ({"sensor.gyro_scale_sd": 0.1}, GYRO),
    ({"sensor.gyro_bias_walk": 0.1}, GYRO),
    ({"sensor.gyro_noise_density": 2e-3}, GYRO),
    ({"initial.orientation": [0.0, 0.0, 1.0, 0.0]}, {}),
    ({"initial.angular_velocity_sd": 0.5}, {}),
    ({"gap.max": 5e-4}, {}),
    ({"motion.rate": 100.0}, {}),
    ({"noise_scale": 2.0}, {}),
    ({"gravity": 9.6}, {}),
    ({"sample_rate": 500.0}, {}),
    ({"integration": "high_order"}, {"method": "ao"}),
    ({"maximum_likelihood": "motion"}, {"mode": "smoothed", "iteration.max": 1}),
    ({"iteration.max": 1}, {"mode": "smoothed"}),
], ids="-".join)
def test_a_parameter_changes_the_estimate(motion, change, with_):
    plain, changed = rows(motion, {}, **with_), rows(motion, change, **with_)
    assert plain.tobytes() != changed.tobytes()


def test_a_body_that_trembles_more_than_still_sd_is_not_still(motion):
    # The noise is 0.05 m/s^2, of which noise_scale explains twice 0.019.
    trembling = {"noise_scale": 0.6}
    assert len(rows(motion, {"initial.still_sd": 0.03}, **trembling))
    with pytest.raises(EstimationError, match="raise initial.still_sd"):
        rows(motion, {"initial.still_sd": 1e-3}, **trembling)
