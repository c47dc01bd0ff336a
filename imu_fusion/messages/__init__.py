"""Samples and estimates to and from the bytes of ROS messages."""
