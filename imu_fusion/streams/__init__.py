"""The estimators between topics: bytes of messages in, bytes of messages out, without ROS."""
