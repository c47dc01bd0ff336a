"""The errors that imu_fusion raises: one root, one child per kind of trouble.

Each message names the file, topic, parameter or stamp, says what was wrong and
what to do. The command line prints the message without a traceback.
"""

INCOMPLETE = 3
"""Exit code: finished, but something was lost."""


def shown(text: str, most: int = 2000) -> str:
    """Text as a terminal may have it: names in a file may hold what speaks to it, and be long."""
    text = text if len(text) <= most else f"{text[:most]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class ImuFusionError(Exception):
    """Root of all errors that this package raises on purpose."""


class ParameterError(ImuFusionError, ValueError):
    """A parameter has an unknown name, a wrong type or a value out of bounds."""


class SampleError(ImuFusionError, ValueError):
    """Samples that no estimator can use: wrong shapes, stamps, units or values."""


class BagError(ImuFusionError):
    """A recording cannot be read or written."""


class MessageError(ImuFusionError, ValueError):
    """The bytes of a message do not fit its type."""


class TopicError(ImuFusionError, LookupError):
    """A topic that is needed is missing from a recording or has another type."""


class CalibrationError(ImuFusionError):
    """The data do not determine the calibration that was asked for."""


class LayoutError(ImuFusionError, ValueError):
    """A sensor layout or a surface definition is degenerate or inconsistent."""


class RefusedError(ImuFusionError):
    """A service was called that can do nothing now."""


class EstimationError(ImuFusionError):
    """An estimator cannot produce a meaningful result from what it was given."""


class DeviceError(ImuFusionError):
    """A device cannot be reached, or does not answer as it should."""
