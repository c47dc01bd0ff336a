"""Messages and bags: samples and estimates to and from ROS types."""
