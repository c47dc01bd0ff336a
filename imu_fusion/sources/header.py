"""What the names of a table's columns say: sensor, axis, unit."""

import re
from dataclasses import dataclass

from imu_fusion.sources import units

# What a column measures: pattern of its name, in lower case and without its unit.
_SENSORS = {
    "linear": r"lin[eé]a|user|(without|ohne).?g|sans.?g",
    "accelerometer": r"acc|beschl|force|^a[_ ]?[xyz]$|^g?f[_ ]?[xyz]$",
    "gyroscope": r"gyr|angular|rot|dreh|omega|^g[_ ]?[xyz]$|^w[_ ]?[xyz]$|rate",
    "magnetometer": r"mag|^m[_ ]?[xyz]$|^b[xyz]$"}
ONES = {
    "lat": r"lat(itude)?", "lon": r"lon(g|gitude)?|lng",
    "height": r"height|h(_?ell)?|alt(itude)?([ _]?ellipsoid(al)?)?|ele(vation)?",
    "north": r"vel[ _]?n(orth)?|vn|v_n", "east": r"vel[ _]?e(ast)?|ve|v_e",
    "down": r"vel[ _]?d(own)?|vd|v_d", "up": r"vel[ _]?u(p)?|vu|v_u",
    "speed": r"speed|velocity|g[ _]?speed", "course": r"course|bearing|direction|head[ _]?mot",
    "h_acc": r"h[ _]?acc|horizontal[ _]?accuracy", "v_acc": r"v[ _]?acc|vertical[ _]?accuracy",
    "s_acc": r"s[ _]?acc|speed[ _]?accuracy", "fix": r"fix[ _]?type",
    "qx": r"q(uat(ernion)?)?[ _.]?x", "qy": r"q(uat(ernion)?)?[ _.]?y",
    "qz": r"q(uat(ernion)?)?[ _.]?z", "qw": r"q(uat(ernion)?)?[ _.]?w"}
TIME = r"(packet|sample|system|sensor|micro\w*|unix|utc|gps)?[ _]?(time|timestamp|stamp|t)" \
        r"([ _]?(stamp|s|ms|us|ns|sec|fine))?|t|i?tow|date.*|seconds.elapsed" \
        r"|(milli|micro|nano)s(econds)?|zeit(stempel)?|temps|tiempo|tempo" \
        r"|.*(?<![a-z])timestamp(?![a-z]).*"
WEEK = r"(gps)?[ _]?(week|wn)([ _]?(no|number))?"
# Units that only one sensor has.
_BY_UNIT = {"gyroscope": units.RATE, "accelerometer": units.ACCELERATION,
            "magnetometer": {"uT": 1.0, "nT": 1.0, "mT": 1.0}}
_UNIT_AT_END = re.compile(r"(.*?)[ _]*(?:[(\[]([^()\[\]]*)[)\]])?\s*$")
_AXIS = re.compile(r"(.*?)(?:^|[ _.\-\[])([xyz])(?![a-z])[\])]?(.*)$|(.*[a-z0-9])([xyz])$")
# Units that follow the name behind an underscore.
_SUFFIX = re.compile(r"(.+)_(deg|rad|m|cm|mm|s|ms|us|ns|g|mg|ut|dps|mps|mps2|rads|degs)$")
_SUFFIXES = {"ut": "uT", "mps": "m/s", "mps2": "m/s^2", "rads": "rad/s", "degs": "deg/s"}


@dataclass
class Column:
    """What the name of a column says: ``kind`` (of a sensor or of ONES, '' for nothing known),
    ``axis`` 0 to 2, ``unit`` as written, ``group`` what tells several sensors of a kind apart,
    ``low`` the name without the unit."""

    name: str
    kind: str = ""
    axis: int | None = None
    unit: str = ""
    group: str = ""
    low: str = ""


def column_of(label: str, name: str, unit: str = "") -> Column:
    """Read what stands above a column that is called ``name``; ``unit``: in a line of its own."""
    match = _UNIT_AT_END.match(label.strip().lstrip("#").strip())
    base, unit = (match[1], match[2] or unit) if match else (label, unit)
    low = written = base.lower().strip()
    suffix = _SUFFIX.match(low)
    if suffix and not unit:
        low, unit = suffix[1], _SUFFIXES.get(suffix[2], suffix[2])
    for kind, pattern in ONES.items():
        if re.fullmatch(pattern, low):
            return Column(name, kind, unit=unit, low=written)
    axis = _AXIS.match(low)
    if axis is None:
        return Column(name, unit=unit, low=written)
    letter = axis[2] or axis[5]
    around = (axis[4] or axis[1] + axis[3]).strip(" _.-")
    kind = next((k for k, p in _SENSORS.items() if re.search(p, low)), "")
    if not kind:    # as in "a_RS_S_x [m s^-2]", or "1X[g]" of the first of several
        kind = next((k for k, known in _BY_UNIT.items() if units.spelled(unit, known)), "")
    return Column(name, kind, "xyz".index(letter), unit, around, written)
