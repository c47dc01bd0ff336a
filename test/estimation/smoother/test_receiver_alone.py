"""Fixes and velocities without an Imu: a body that nobody has felt."""

import numpy as np
import pytest

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.evaluation.consistency import nees
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, VelocityLog
from imu_fusion.simulation.noise_gnss import GnssErrors, gnss_errors

EPOCH, ORIGIN = 10**18, LocalFrame(47.3, 11.4, 2000.0)
ERRORS = GnssErrors(position_sd=(1.5, 1.5, 3.0), position_tau=20.0, velocity_sd=(0.1, 0.1, 0.2),
                    velocity_tau=0.5)


def descent(time):
    """Places and velocities (n, 3): at rest, 60 s of bends at up to 20 m/s, at rest."""
    grid = np.arange(0.0, 120.0, 0.01)
    speed = 20.0 * np.clip(np.minimum((grid - 30.0) / 5.0, (90.0 - grid) / 10.0), 0.0, 1.0)
    course = 0.8 * np.sin(0.25 * grid)
    vel = speed[:, None] * np.column_stack([np.cos(course), np.sin(course),
                                            np.full(len(grid), -0.5)])
    place = np.cumsum(vel, axis=0) * 0.01
    return tuple(np.column_stack([np.interp(time, grid, v) for v in values.T])
                 for values in (place, vel))


def recorded(rng, outage=(0.0, 0.0), frame=ORIGIN):
    """Times, and the logs of a 5 Hz receiver that states what it errs by."""
    time = np.arange(0.0, 120.0, 0.2)
    time = time[(time < outage[0]) | (time >= outage[1])]
    place, vel = descent(time)
    position_error, velocity_error = gnss_errors(time, ERRORS, rng)
    stamp = EPOCH + np.round(time * 1e9).astype(np.int64)
    cov, cov_vel = (np.tile(np.diag(np.square(sd)), (len(time), 1, 1))
                    for sd in (ERRORS.position_sd, ERRORS.velocity_sd))
    return (FixLog(stamp, *frame.to_geodetic(place + position_error), cov, np.zeros(len(time))),
            VelocityLog(stamp, vel + velocity_error, cov_vel))


def errors_of(result):
    place, vel = descent((result.samples["stamp"] - EPOCH) * 1e-9)
    origin = ORIGIN.to_enu(*result.frame.to_geodetic(np.zeros(3)))
    return (result.samples["position_world"] + origin - place,
            result.samples["vel_world"] - vel)


@pytest.mark.parametrize("outage", [(0.0, 0.0), (40.0, 46.0)])
def test_places_and_velocities_err_as_they_say(outage):
    fix, velocity = recorded(np.random.default_rng(5), outage)
    result = Smoother(SmootherParams()).run(None, None, fix, velocity)
    samples = result.samples
    assert result.converged and result.acc_density is not None
    # Through the outage, too: no two samples are more than .1 s apart.
    assert np.diff(samples["stamp"]).max() <= 100_000_000
    place, vel = errors_of(result)
    assert 0.2 < nees(place, samples["cov_position"]).mean() < 9.0
    assert 0.2 < nees(vel, samples["cov_velocity"]).mean() < 9.0
    assert np.sqrt(np.mean(np.sum(vel ** 2, axis=1))) < (0.25 if outage == (0.0, 0.0) else 1.5)
    # What a receiver states of a place does not average out.
    assert np.sqrt(samples["cov_position"][:, 0, 0]).min() > 0.3
    # Nobody knows the attitude.
    assert samples["cov_attitude"][:, 0, 0].min() > np.pi ** 2
    assert np.isnan(samples["acc"]).all()
    assert any("no Imu samples" in remark for remark in result.remarks())


def test_a_throw_in_an_outage_is_not_known():
    """At rest for minutes, 20 m/s afterwards, and nothing seen in between."""
    fix, velocity = recorded(np.random.default_rng(6), (29.0, 36.0))
    result = Smoother(SmootherParams()).run(None, None, fix, velocity)
    time = (result.samples["stamp"] - EPOCH) * 1e-9
    unseen = (time > 30.0) & (time < 35.0)
    _, vel = errors_of(result)
    assert nees(vel, result.samples["cov_velocity"])[unseen].mean() < 9.0


def test_what_cannot_be_smoothed_says_why():
    fix, velocity = recorded(np.random.default_rng(7))
    smoother = Smoother(SmootherParams())
    with pytest.raises(EstimationError, match="no valid GNSS fix"):
        smoother.run(None, None, None, velocity)
    with pytest.raises(EstimationError, match="2 usable fixes and no Imu"):
        smoother.run(None, None, fix[:2], velocity)
    with pytest.raises(EstimationError, match="needs an Imu"):
        Smoother(SmootherParams(method="extended_rts")).run(None, None, fix, velocity)
    # Without velocities, and without a fit.
    alone = Smoother(SmootherParams(maximum_likelihood="off")).run(None, None, fix)
    assert alone.acc_density == SmootherParams().gap.acc_noise_density
    assert np.abs(errors_of(alone)[0]).max() < 15.0
