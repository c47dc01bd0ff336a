"""What was measured: typed logs, merging by stamp, gaps. No ROS, no files."""

from imu_fusion.samples.logs import (AccelerometerLog, FixLog, ImuLog, MagLog, PoseLog,
                                     VelocityLog, seconds)

__all__ = ["AccelerometerLog", "FixLog", "ImuLog", "MagLog", "PoseLog", "VelocityLog",
           "seconds"]
