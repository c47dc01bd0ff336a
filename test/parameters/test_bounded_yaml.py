"""YAML from anybody: within bounds, or refused by name."""

import pytest

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.parameters.bounded_yaml import MAX_BYTES, parse_yaml, read_yaml
from imu_fusion.parameters.file import load

BOMB = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))


def test_plain_yaml_is_read_in_every_encoding_that_yaml_permits():
    for data in ("a: [1, 2.5, x]", b"\xef\xbb\xbfa: [1, 2.5, x]",
                 "\ufeffa: [1, 2.5, x]".encode("utf-16-le"), "a:\r\n- 1\r\n- 2.5\r\n- x\r\n"):
        assert parse_yaml(data, "f") == {"a": [1, 2.5, "x"]}
    assert parse_yaml("a: !!python/tuple [1, 2]", "f") == {"a": [1, 2]}    # as launch_ros writes
    assert parse_yaml("a: &k {b: 1}\nc: *k\nd: {<<: *k, e: 2}", "f")["d"] == {"b": 1, "e": 2}
    assert parse_yaml("", "f") is None


@pytest.mark.parametrize("text, words", [
    ("[" * 5000, "nest"), ("a: " * 3 + "\n" + "- " * 400, "YAML|nested"),
    ("[" * 40 + "]" * 40, "nested deeper than 32"),
    (BOMB, "stands for more than"), ("a: &a [*a]", "contains itself"),
    ("&a {b: {c: *a}}", "contains itself"), ("*a", "is not YAML"),
    ("!!python/object/apply:os.system [id]", "is not YAML"),
    ("a: 1\nb: 2\na: 3", "line 3: the key 'a' stands here twice"),
    ("? [1, 2]\n: 3", "cannot be read|is not YAML"), ("a: 2001-13-45", "cannot be read"),
    ("a: " + "9" * 10000, "cannot be read"), ("a: b\0c", "is not YAML"), ("\xff\xfe\x00", "YAML"),
    ("a: 'b", "is not YAML"), ("%YAML 9.9\n--- a", "is not YAML"),
])
def test_what_is_beyond_the_bounds_is_refused(text, words):
    with pytest.raises(ParameterError, match=words) as caught:
        parse_yaml(text.encode("latin-1"), "file.yaml")
    assert str(caught.value).startswith("file.yaml") and len(str(caught.value)) < 500


def test_files_are_refused_by_name(tmp_path):
    for name, data in (("large.yaml", b"#" * (MAX_BYTES + 1)), ("binary.yaml", bytes(range(256)))):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ParameterError, match=name):
            read_yaml(tmp_path / name)
    for name in ("missing.yaml", "no\0name.yaml", "."):
        with pytest.raises(ParameterError, match="cannot be read"):
            read_yaml(tmp_path / name)


@pytest.mark.parametrize("body", ["[1]", "x", "5"])
def test_parameters_of_a_node_are_a_mapping(tmp_path, body):
    (tmp_path / "p.yaml").write_text(f"node:\n  ros__parameters: {body}\n")
    with pytest.raises(ParameterError, match="must map names to values"):
        load(tmp_path / "p.yaml")


def test_numbers_of_hundreds_of_digits_are_out_of_bounds():
    for name in ("lag", "sensor.gyro_noise_density"):
        with pytest.raises(ParameterError, match="out of bounds") as caught:
            OrientationParams.from_mapping({name: 10 ** 400})
        assert len(str(caught.value)) < 300
