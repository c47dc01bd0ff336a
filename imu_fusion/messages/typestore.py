"""The message types of ROS 2 Jazzy, without a ROS installation."""

from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
