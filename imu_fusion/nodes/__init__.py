"""ROS 2 nodes: thin adapters that decode, call an estimator and encode."""
