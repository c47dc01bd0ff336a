"""One linear problem about a trajectory, solved exactly by a pass forward and one back (numba).

Memory: the filter keeps the deviation and covariance at the first sample of each segment only;
the pass back runs each segment forward once more to get what it needs. Both runs execute the same
operations, so they agree bit for bit.
"""

import numpy as np

from imu_fusion.estimation.smoother.backward_pass import Adjoint, Smoothed, smooth_segment
from imu_fusion.estimation.smoother.forward_filter import filter_segment, make_storage
from imu_fusion.estimation.smoother.records import Recording, make_scratch
from imu_fusion.estimation.smoother.transition import apply_step
from imu_fusion.kernels import njit

#: Samples kept at once by the pass back: with 21 states some 0.6 MB, within the cache of a core.
SEGMENT = 128


@njit
def solve_linear(x: np.ndarray, delta: np.ndarray, cov: np.ndarray, recording: Recording,
                 fit: np.ndarray, cov_out: np.ndarray, var_out: np.ndarray
                 ) -> tuple[float, float, float, np.ndarray]:
    """Solve the problem linearised about x (N, n + 1) and move x to its solution.

    Args:
        delta, cov: prior deviation (n,) and covariance (n, n) of the first sample.
        fit: (M,) of records.FIT, result.
        cov_out, var_out: as in :class:`.backward_pass.Smoothed`, results.

    Returns:
        Loss of all rows before the step, negative logarithm of their likelihood, squared normalised
        process noise after the step, largest changes (3,) of position, velocity and attitude.
    """
    total, n = len(x), len(delta)
    count = (total + SEGMENT - 1) // SEGMENT
    kept_delta, kept_cov = np.empty((count, n)), np.empty((count, n, n))
    readings, contacts = recording.reading_start, recording.contact_start
    most, cost, surprise, process = 0, 0.0, 0.0, 0.0
    # A constant would have the filter compiled a second time for it.
    follow = np.zeros(1, np.bool_)[0]
    nothing, scratch = make_storage(0, 0, n), make_scratch(n)
    for s in range(count):
        first, last = s * SEGMENT, min((s + 1) * SEGMENT, total)
        kept_delta[s], kept_cov[s] = delta, cov
        most = max(most, 3 * (readings[last] - readings[first]) + contacts[last] - contacts[first])
        loss, unlikely = filter_segment(first, last, follow, x, delta, cov, recording, fit, nothing,
                                        scratch)
        cost += loss
        surprise += unlikely
    storage = make_storage(SEGMENT, most, n)
    smoothed, largest = Smoothed(np.empty((SEGMENT, n)), cov_out, var_out), np.zeros(3)
    adjoint = Adjoint(np.zeros(n), np.zeros((n, n)))
    for s in range(count - 1, -1, -1):
        first, last = s * SEGMENT, min((s + 1) * SEGMENT, total)
        filter_segment(first, last, follow, x, kept_delta[s], kept_cov[s], recording, fit,
                       storage, scratch)
        process += smooth_segment(first, last, adjoint, recording, storage, smoothed, scratch)
        apply_step(x[first:last], smoothed.step, largest)
    return cost, surprise, process, largest
