"""Every parameter matters to the trajectory, or is refused where it does not."""

import dataclasses

import numpy as np
import pytest

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.samples.logs import FixLog, VelocityLog
from imu_fusion.simulation.jump_sensors import EPOCH, GnssErrors, PhoneErrors, record
from imu_fusion.streams.smoother_params import SmoothingParams

#: Another value of each parameter, and what has to be set with it.
CHANGED = {
    "gravity": (9.79, {}),
    "magnetic_field": ((1e-6, 21e-6, -43e-6), {}),
    "sensor.gyro_noise_density": (3e-3, {}),
    "sensor.gyro_bias_sd": (0.02, {}),
    "sensor.gyro_bias_walk": (1e-4, {}),
    "sensor.gyro_scale_sd": (0.02, {}),
    "sensor.gyro_range": ((2.0,), {}),
    "sensor.acc_noise_density": (2e-2, {}),
    "sensor.acc_bias_sd": (0.1, {}),
    "sensor.acc_bias_walk": (1e-3, {}),
    "sensor.acc_matrix_sd": (0.02, {}),
    "sensor.acc_range": ((25.0,), {}),     # 30 is found
    "sensor.mag_noise_sd": (1e-5, {}),
    "sensor.mag_bias_sd": (1e-6, {}),
    "sensor.mag_scale_sd": (0.01, {}),
    "sensor.mag_axes_sd": (0.02, {}),
    "gap.max": (0.03, {}),
    "gap.gyro_noise_density": (0.3, {"sensor.gyro_range": (2.0,)}),
    "gap.acc_noise_density": (0.5, {"sensor.acc_range": (30.0,)}),
    "gnss.fix_sd": ((1.0, 1.0, 2.0), {}),
    "gnss.velocity_sd": ((0.2, 0.2, 0.2), {}),
    "gnss.covariances": (False, {}),
    "gnss.loss": ("squared", {}),
    "gnss.loss_scale": (2.0, {}),
    "gnss.position_error_sd": ((1.0, 1.0, 2.0), {}),
    "gnss.position_error_tau": (100.0, {"gnss.position_error_sd": (1.0, 1.0, 2.0)}),
    "gnss.velocity_error_sd": ((0.1, 0.1, 0.1), {}),
    "gnss.velocity_error_tau": (3.0, {"gnss.velocity_error_sd": (0.1, 0.1, 0.1)}),
    "gnss.even_stamps": (True, {}),
    "gnss.min_interval": (0.25, {}),
    "gnss.time_offset_sd": (0.1, {}),
    "gnss.velocity_time_offset_sd": (0.1, {}),
    "gnss.lever_arm": ((0.0, 0.1, -0.2), {}),
    "gnss.lever_arm_sd": (0.2, {}),
    "maximum_likelihood": ("off", {"gnss.covariances": False,
                                   "gnss.velocity_sd": (0.02, 0.02, 0.06),
                                   "surface.interval": 10.0}),
    "mag.loss": ("squared", {}),
    "mag.loss_scale": (2.0, {}),
    "surface.body_height": (0.3, {}),
    "surface.body_height_sd": (0.3, {}),
    "surface.lever_arm": ((0.0, 0.0, -0.5), {}),
    "surface.lever_arm_sd": (0.5, {}),
    "surface.interval": (0.1, {}),
    "surface.windows": ((0.0, 1.5, 5.0, 6.0), {}),
    "jump.takeoff": (2.05, {}),
    "jump.touchdown": (5.0, {}),
    "jump.event_margin": (0.1, {}),
    "initial.attitude_sd": (0.1, {}),
    "sensor.mag_offset": ((1e-6, 2e-6, 0.0), {}),
    "sensor.mag_matrix": ((1.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), {}),
    "initial.start": (0.05, {}),
    "initial.position": ((47.4, 10.28, 900.0), {}),
    "initial.position_sd": (2.0, {}),
    "initial.speed_sd": (1.0, {}),
    "iteration.max": (2, {}),
    "iteration.tolerance": (1e-6, {"iteration.cost_tolerance": 0.0}),
    "iteration.cost_tolerance": (100.0, {}),
}
#: This recording has no rest: see test_rests.
OF_RESTS = {"rest.found", "rest.shortest", "rest.velocity_sd"}
METHODS = ("iterated", "extended_rts")


def test_no_parameter_is_left_out():
    assert {"method", *CHANGED, *OF_RESTS} == {info.name for info in SmootherParams.infos()}
    assert set(SmootherParams.OLD_NAMES.values()) <= set(CHANGED)


@pytest.fixture(scope="module")
def logs(jump):
    """Around a flight: clipped readings, a step of 50 ms, jittered stamps, every third fix and
    velocity without a covariance. The first second is in the in-run."""
    r = record(jump, np.random.default_rng(12), PhoneErrors(gyr_range=2.0),
               GnssErrors(outlier_share=0.05))
    begin = EPOCH + int((jump.t_takeoff - 2.0) * 1e9)
    imu = r.imu.between(begin, begin + 7_000_000_000)
    imu = dataclasses.replace(imu, acc=np.clip(imu.acc, -30.0, 30.0))
    imu = imu[np.r_[0:250, 254:len(imu)]]

    def known(cov):
        return np.where(np.arange(len(cov))[:, None, None] % 3 == 0, 0.0, 1.5 * cov)

    fix, velocity = r.fix, r.velocity
    stamp = fix.stamp + np.random.default_rng(1).integers(0, 20_000_000, len(fix))
    fix = FixLog(stamp, fix.latitude_deg, fix.longitude_deg, fix.height, known(fix.cov_enu),
                 fix.status)
    velocity = VelocityLog(stamp, velocity.vel_world, known(velocity.cov_world))
    return imu, r.mag, fix, velocity


def smoothed(jump, logs, method, changes):
    """Bytes of the samples of a hill, take-off and touch-down known."""
    given = {"method": method, "jump.takeoff": 2.0,
             "jump.touchdown": 2.0 + jump.t_touchdown - jump.t_takeoff}
    params = SmootherParams.from_mapping({**given, **changes})
    return Smoother(params, jump.hill).run(*logs).samples.tobytes()


@pytest.fixture(scope="module")
def usual(jump, logs):
    """(method, further parameters) -> bytes, computed once."""
    known = {}

    def get(method, changes):
        key = method, tuple(changes.items())
        if key not in known:
            known[key] = smoothed(jump, logs, method, changes)
        return known[key]
    return get


@pytest.mark.parametrize("name", CHANGED)
@pytest.mark.parametrize("method", METHODS)
def test_a_parameter_matters_or_is_refused(jump, logs, usual, method, name):
    value, needed = CHANGED[name]
    idle = [key for key, why in SmootherParams(method=method).idle().items() if "method" in why]
    if any(name == key or (key.endswith(".") and name.startswith(key)) for key in idle):
        with pytest.raises(ParameterError, match=f"'{name}': does nothing with"):
            SmootherParams.from_mapping({"method": method, name: value})
        return
    assert smoothed(jump, logs, method, {**needed, name: value}) != usual(method, needed)


def test_what_the_paper_does_not_know_is_told_by_name():
    with pytest.raises(ParameterError, match="'gnss.lever_arm': does nothing with method 'exten"):
        SmootherParams.from_mapping({"method": "extended_rts", "gnss.lever_arm": [0.0, 1.0, 0.0]})


@pytest.mark.parametrize("values, text", [
    ({"gnss": {"loss": "squared", "loss_scale": 3.0}}, "'gnss.loss_scale': .* gnss.loss 'squared'"),
    ({"gnss.position_error_tau": 9.0}, "'gnss.position_error_tau': .* gnss.position_error_sd"),
    ({"surface.interval": 1.0}, "'surface.interval': does nothing without surface.file"),
    ({"jump.takeoff": 1.0}, "'jump.takeoff': does nothing without surface.file"),
    ({"fix_loss_scale": 0.0}, "'fix_loss_scale' is called 'gnss.loss_scale' now"),
    ({"gnss.loss_scale": 0.0}, "'gnss.loss_scale'.*0.0 is out of bounds"),
    ({"surface": "hill.yaml"}, "'surface' is called 'surface.file' now"),
    ({"mag_sd": 1e-6}, "'mag_sd' is called 'sensor.mag_noise_sd' now"),
])
def test_what_does_nothing_or_has_another_name_is_refused(values, text):
    with pytest.raises(ParameterError, match=text):
        SmoothingParams.from_mapping(values)


def test_ranges_can_differ_by_axis(jump, recording):
    """An axis that is never clipped is used as it is."""
    limit = float(np.abs(recording.imu.gyr[:, 0]).max()) / 2
    imu = dataclasses.replace(recording.imu, gyr=np.clip(
        recording.imu.gyr, [-limit, -np.inf, -np.inf], [limit, np.inf, np.inf]))
    params = SmootherParams.from_mapping({"sensor.gyro_range": [limit, 100.0, 100.0]})
    samples = Smoother(params, jump.hill).run(imu, recording.mag, recording.fix,
                                              recording.velocity).samples
    lost = np.abs(imu.gyr) >= 0.999 * limit
    assert lost[:, 0].any() and lost[:, 1:].any()
    usual = np.median(samples["gyr_sd"])
    assert samples["gyr_sd"][lost[:, 0], 0].min() > 2 * usual
    assert samples["gyr_sd"][:, 1:].max() < 1.1 * usual
