"""A fix after a step of all fixes: another height datum, antenna or base. As :mod:`.gnss_fix`, and
an offset that stands still."""

from imu_fusion.estimation.smoother.measurements import gnss_fix
from imu_fusion.estimation.smoother.measurements.measurement import Measurement
from imu_fusion.estimation.smoother.state import slow
from imu_fusion.kernels import njit


@njit
def predict(x, tau, step, model, rows):
    """As :func:`.gnss_fix.predict`."""
    gnss_fix.predict(x, tau, step, model, rows)
    offset = model.blocks.gnss_step
    for i in range(3):
        rows.predicted[i] += slow(x, offset + i)
        rows.h[i, offset + i] = 1.0


MEASUREMENT = Measurement("moved_fix", "position after the step", gnss_fix.MEASUREMENT.components,
                          gnss_fix.prepare, gnss_fix.MEASUREMENT.advice,
                          gnss_fix.MEASUREMENT.delays)
