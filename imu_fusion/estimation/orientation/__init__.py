"""Orientation from gyroscope, accelerometer and magnetometer: the error-state filter and its
smoother, and Winkler's method as printed."""
