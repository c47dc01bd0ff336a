"""Recordings through the commands that read them."""

from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.recordings.bag_reader import open_bag

DOORS = ["info", "process", "convert", "repair"]


def run(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments])


def through(door, path, out):
    """One command on a recording; a traceback fails the test."""
    arguments = {"info": ["info", path], "process": ["process", path, out],
                 "convert": ["convert", path, out], "repair": ["info", path, "--repair", out]}
    result = run(*arguments[door])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def rows_of(path):
    with open_bag(path) as reader:
        return list(reader.messages()), reader
