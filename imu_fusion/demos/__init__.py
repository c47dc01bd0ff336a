"""``imu_fusion demo``: the main jobs on recordings, through real ROS 2 nodes."""
