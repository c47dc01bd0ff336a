"""A signal that ends a process arrives as what it is."""

import importlib
import signal

import pytest

from imu_fusion.signals import Interrupted, came, interruptible

# What extension modules (pybind11) do with an exception that comes into their initialisation, and
# what becomes of a module that somebody else has imported only in part.
MODULES = {"extension": """
import signal
try:
    signal.raise_signal({number})
except BaseException as error:
    raise ImportError("initialization failed") from error
""", "half_made": """
import signal
import types
try:
    signal.raise_signal({number})
except BaseException:
    pass
types.no_such_thing
"""}


@pytest.fixture(autouse=True)
def nothing_came():
    yield
    came.clear()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", MODULES)
def test_what_an_import_makes_of_a_signal_is_the_signal(tmp_path, monkeypatch, number, name):
    (tmp_path / f"{name}_{int(number)}.py").write_text(MODULES[name].format(number=int(number)))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Interrupted) as caught, interruptible():
        importlib.import_module(f"{name}_{int(number)}")
    assert caught.value.code == 128 + number


def test_an_error_while_a_signal_ends_the_work_is_still_an_error():
    with pytest.raises(OSError, match="disk full"), interruptible():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            raise OSError("disk full")


def test_an_import_that_fails_by_itself_is_still_an_error():
    with pytest.raises(ModuleNotFoundError), interruptible():
        importlib.import_module("imu_fusion.no_such_module")
