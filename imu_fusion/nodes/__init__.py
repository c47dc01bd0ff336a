"""ROS 2 nodes: thin adapters that decode, call an estimator and encode."""

NODES = ("replayer", "recorder", "orientation_estimator", "smoother",
         "acceleration_field_estimator", "smoothing_trigger")
"""Module names; each has ``main(args)`` and is an executable of the package."""
