"""Parameters: declared once as frozen dataclasses; ROS, YAML, command line and docs from them."""
