"""``python -m imu_fusion.cli``, for processes that start others."""

from imu_fusion.cli import main

main()
