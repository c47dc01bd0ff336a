"""Noise presets, calibration and saturation recovery. No ROS, no files."""
