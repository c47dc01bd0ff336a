"""Shared by all tests: localhost-only discovery and an own ROS domain per run."""

import os

# Before any import of rclpy: a graph of somebody else on this machine must not be heard.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 200)
