"""What was measured: typed logs, merging by stamp, gaps. No ROS, no files."""

from imu_fusion.samples.logs import (
                                     AccelerometerLog,
                                     AttitudeLog,
                                     FixLog,
                                     ImuLog,
                                     MagLog,
                                     PoseLog,
                                     VelocityLog,
                                     seconds,
)

__all__ = ["AccelerometerLog", "AttitudeLog", "FixLog", "ImuLog", "MagLog", "PoseLog",
           "VelocityLog", "seconds"]
