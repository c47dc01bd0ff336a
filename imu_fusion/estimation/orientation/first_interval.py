"""Where a whole recording begins."""

from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.motion_span import last_rest


def from_start(imu: ImuLog, params: OrientationParams) -> ImuLog:
    """The samples from ``alignment.start`` on, or from the rest that is found in its place."""
    start = params.alignment.start
    if start is not None and len(imu):
        return imu[imu.stamp >= imu.stamp[0] + round(start * 1e9)]
    return imu if params.fusion.use_acc else imu[last_rest(imu, params.alignment.duration):]
