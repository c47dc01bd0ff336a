"""What the best estimate of a ball's place between known ends errs by: for benchmarks.avalanche."""

import numpy as np

from imu_fusion.simulation.avalanche import AvalancheParams
from imu_fusion.simulation.ball_sensors import RATE, BallErrors

FIX_SD = 0.2          # m, of fixes averaged over minutes
STEP = 0.02           # s, of the grid


def least_error(gap):
    """RMS, m, along one axis from -3 to 73 s, of the best estimate of a ball whose attitude and
    sensors' constants are known at every instant, between two rests at known places: nothing errs
    but the noise of the accelerometer's samples, and the fixes. Two integrations on a grid of STEP.

    gap: (begin, end) s without samples; the acceleration there is that of the flow's jerks, whose
    size is known, too.
    """
    time = np.arange(-3.0, 73.0, STEP)
    inside = (time >= gap[0]) & (time < gap[1])
    unfelt = 5.0 * AvalancheParams().jerk ** 2    # five jerks per second
    q = np.where(inside, unfelt, BallErrors().acc_sd ** 2 / RATE)
    step = np.array([[1.0, STEP], [0.0, 1.0]])
    noise = np.array([[STEP ** 3 / 3, STEP ** 2 / 2], [STEP ** 2 / 2, STEP]])
    known = np.diag([FIX_SD ** 2, 0.0])           # at either end it rests
    forward = [known]
    for k in range(len(time) - 1):
        forward.append(step @ forward[-1] @ step.T + q[k] * noise)
    cov, places = np.linalg.inv(np.linalg.inv(forward[-1]) + np.diag([FIX_SD ** -2, 1e6])), []
    for k in range(len(time) - 2, -1, -1):
        places.append(cov[0, 0])
        ahead = step @ forward[k] @ step.T + q[k] * noise
        gain = forward[k] @ step.T @ np.linalg.inv(ahead)
        cov = forward[k] + gain @ (cov - ahead) @ gain.T
    return float(np.sqrt(np.mean(places)))
