"""The estimators: pure classes, no ROS, no files, no clock, no plotting."""
