"""Shared by all tests: localhost-only discovery and an own ROS domain per run."""

import os
import signal

# Before any import of rclpy: a graph of somebody else on this machine must not be heard.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
# Beyond the 101 domains among which a demo or pipeline chooses: a test beside it may start one.
os.environ["ROS_DOMAIN_ID"] = str(102 + os.getpid() % 99)
# Under nohup SIGHUP is ignored, by children too, and what tests of it send is not heard.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
