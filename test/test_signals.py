"""A signal that ends a process arrives as what it is."""

import signal

import pytest

from imu_fusion.signals import Interrupted, came, interruptible


@pytest.fixture(autouse=True)
def nothing_came():
    yield
    came.clear()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_an_extension_module_makes_of_a_signal_is_the_signal(number):
    with pytest.raises(Interrupted) as caught, interruptible():
        try:
            signal.raise_signal(number)
        except Interrupted as error:
            raise ImportError("initialization failed") from error    # as pybind11 does
    assert caught.value.code == 128 + number


def test_an_error_while_a_signal_ends_the_work_is_still_an_error():
    with pytest.raises(OSError, match="disk full"), interruptible():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            raise OSError("disk full")
