"""Parameter files that convert has written, read by the parser of ROS itself."""

import rclpy
import yaml

from imu_fusion import nodes
from imu_fusion.nodes.acceleration_field_estimator import AccelerationFieldEstimatorNode
from imu_fusion.recordings.convert import convert
from test.recordings.test_array_table import describe, write


def test_a_node_takes_the_parameter_file_of_a_table(tmp_path):
    description = describe()
    sensors = description["accelerometers"]
    # Names, like the axis y, that YAML 1.1 would take for truth values.
    for old, new in (("front", "on"), ("left", "y"), ("back", "n")):
        sensors[new] = sensors.pop(old)
    sensors["top"] |= {"measured_axes": ["x", "y"], "columns": ["top_x", "top_y"]}
    source, file, out = write(tmp_path, description, rows=3)
    parameter_file = convert(source, out, file).parameter_file
    rclpy.init(args=["--ros-args", "--params-file", str(parameter_file)])
    try:
        node = AccelerationFieldEstimatorNode()
        config = node._stream.config
        assert set(config.accelerometers) == {"on", "y", "n", "top"}
        assert config.accelerometers["on"].position == (0.15, 0.0, 0.0)
        assert config.accelerometers["top"].measured_axes == ("x", "y")
        assert config.field.use_gyro and config.field.sample_rate == 100.0
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_a_file_that_ros_cannot_parse_is_one_line(tmp_path, capsys):
    file = tmp_path / "p.yaml"
    file.write_text(yaml.safe_dump({"acceleration_field_estimator": {
        "ros__parameters": {"accelerometers": {"names": [1, "two"]}}}}))
    assert nodes.main(["--ros-args", "--params-file", str(file)],
                      "acceleration_field_estimator") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("acceleration_field_estimator: ") and "p.yaml" in line
