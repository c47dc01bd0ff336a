"""Rotations, geodesy, gravity and the magnetic field. No ROS, no files."""
