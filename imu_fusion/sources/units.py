"""Units as files and data sheets write them, as factors to SI."""

import math

from imu_fusion.sources.source import STANDARD_GRAVITY

ACCELERATION = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}
RATE = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mdeg/s": math.pi / 180e3}
FIELD = {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
SPEED = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6, "kn": 1852 / 3600}
#: To degrees, in which latitude and longitude are kept.
ANGLE = {"deg": 1.0, "1e-5 deg": 1e-5, "1e-7 deg": 1e-7, "rad": 180.0 / math.pi}
TIME = {"s": 9, "ms": 6, "us": 3, "ns": 0}    # powers of ten to nanoseconds

_SPELLINGS = {
    "m/s²": "m/s^2", "m/s2": "m/s^2", "m/s/s": "m/s^2", "m·s⁻²": "m/s^2", "ms-2": "m/s^2",
    "m s-2": "m/s^2", "m s^-2": "m/s^2", "mps2": "m/s^2", "ms^-2": "m/s^2", "m/sec^2": "m/s^2",
    "m/(s^2)": "m/s^2",
    "°/s": "deg/s", "dps": "deg/s", "degps": "deg/s", "deg/sec": "deg/s", "mdps": "mdeg/s",
    "rad/sec": "rad/s", "rad s^-1": "rad/s", "rad s-1": "rad/s", "deg s^-1": "deg/s",
    "rps": "rad/s", "µt": "uT", "μt": "uT", "ut": "uT", "microtesla": "uT",
    "nt": "nT", "mt": "mT", "t": "T", "gauss": "G", "ga": "G", "mgauss": "mG",
    "°": "deg", "degrees": "deg", "deg1e-7": "1e-7 deg", "deg1e7": "1e-7 deg",
    "deg1e-5": "1e-5 deg", "mps": "m/s", "mm/s": "mm/s", "kmh": "km/h", "kph": "km/h",
    "knots": "kn", "kt": "kn", "meters": "m", "metres": "m",
    "sec": "s", "seconds": "s", "second": "s", "msec": "ms", "milliseconds": "ms",
    "µs": "us", "μs": "us", "usec": "us", "micro seconds": "us", "microseconds": "us",
    "nanoseconds": "ns"}


def spelled(text: str, units: dict) -> str | None:
    """The unit of ``units`` that a text stands for, None if it is none of them."""
    text = text.strip()
    for candidate in (text, _SPELLINGS.get(text.lower(), ""), text.lower()):
        if candidate in units:
            return candidate
    return None
