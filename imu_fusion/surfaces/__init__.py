"""Where the body can be: plane, elevation grid, FIS hill. No ROS, no files."""
