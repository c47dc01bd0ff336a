"""Trajectories as AvaFrame's comparison of particles reads them (ana5Utils, particle analysis)."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import BagError, TopicError
from imu_fusion.messages.layouts import FIX, NANOSECONDS, ODOMETRY
from imu_fusion.recordings.bag_reader import Lose, Reader, open_bag
from imu_fusion.recordings.logs import decoded_blocks
from imu_fusion.recordings.targets import refuse_source, whole_file
from imu_fusion.samples.blocks import joined

_ODOMETRY, _FIX = "smoother/odometry", "smoother/fix"
#: Its names: places in m, velocities in m/s along the axes of the places, time in s.
COLUMNS = ("X", "Y", "Z", "ux", "uy", "uz", "velocityMag", "uAcc", "trajectoryLengthXY",
           "trajectoryLengthXYZ", "time")


def particle_table(time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Rows (n, 11) of :data:`COLUMNS`.

    uAcc is the change of the velocity's size, as AvaFrame computes it; lengths are those of the
    path since the first row.

    Args:
        time: (n,) s. position, velocity: (n, 3) m, m/s.
    """
    speed = np.linalg.norm(velocity, axis=1)
    steps = np.diff(position, axis=0, prepend=position[:1])
    return np.column_stack([
        position, velocity, speed, np.gradient(speed, time),
        np.cumsum(np.hypot(steps[:, 0], steps[:, 1])),
        np.cumsum(np.linalg.norm(steps, axis=1)), time - time[0]])


def export_avaframe(path: str | Path, out: str | Path, crs: str | None = None,
                    interval: float = 0.1, lose: Lose = lambda text: None) -> int:
    """Write the smoothed trajectory of a recording as a CSV file.

    Args:
        path: recording with smoother/odometry. out: file to write. crs: reference system of X and
            Y, such as EPSG:31254; None: east and north of the origin. Z is the ellipsoidal height
            with it, without it up from the origin. interval: s, between rows. lose: called with
            texts on what of the recording cannot be read.

    Returns:
        number of rows.

    Raises:
        TopicError: no smoothed trajectory. BagError: no such reference system, or the file cannot
            be written.
    """
    refuse_source(path, out)
    with open_bag(path) as reader:
        stamp, values = _decoded(reader, _ODOMETRY, ODOMETRY)
        usable = np.linalg.norm(values[:, ODOMETRY["orientation"]], axis=1) > 0.5    # not NaN
        stamp, values = stamp[usable], values[usable]
        place = None
        if crs is not None:
            fix_stamp, fixes = _decoded(reader, _FIX, FIX)
            stamp, rows, of_fix = np.intersect1d(stamp, fix_stamp, return_indices=True)
            values, place = values[rows], fixes[of_fix, FIX_PLACE]
    if len(stamp) < 2 or stamp[-1] - stamp[0] < interval * NANOSECONDS:
        raise TopicError(f"{path}: {len(stamp)} messages on {_ODOMETRY} are no trajectory of "
                         f"{interval:g} s")
    for text in reader.losses:
        lose(text)
    velocity = Rotation.from_quat(values[:, ODOMETRY["orientation"]]).apply(
        values[:, ODOMETRY["linear"]])
    position = values[:, ODOMETRY["position"]]
    if place is not None:
        position, velocity = _projected(place, velocity, crs)
    time = (stamp - stamp[0]) * 1e-9
    rows = np.unique(np.searchsorted(time, np.arange(0.0, time[-1] + 1e-9, interval)))
    table = particle_table(time[rows], position[rows], velocity[rows])
    header = ",".join(COLUMNS)
    with whole_file(out, header) as file:
        np.savetxt(file, table, delimiter=",", header=header, comments="", fmt="%.6f")
    return len(table)


#: Latitude, longitude (deg) and height (m) among the values of a NavSatFix.
FIX_PLACE = slice(2, 5)


def _decoded(reader: Reader, topic, layout):
    name = reader.require(topic).name
    blocks = [(block.stamp, block.values) for block in decoded_blocks(reader, name, layout)]
    return joined([(np.empty(0, np.int64), np.empty((0, layout.size))), *blocks])


def _projected(place, velocity, crs):
    """Positions and velocities (n, 3) in a reference system: grid north is not north."""
    from pyproj import CRS, Geod, Transformer  # an extra
    from pyproj.exceptions import CRSError
    try:
        to_map = Transformer.from_crs("EPSG:4979", CRS(crs), always_xy=True)
    except CRSError as error:
        raise BagError(f"no reference system {crs!r}: {error}") from None
    latitude, longitude, height = place.T
    x, y = to_map.transform(longitude, latitude)
    # Where a kilometre north of the middle lies on the map turns the velocities.
    middle = len(x) // 2
    east, north, _ = Geod(ellps="WGS84").fwd(longitude[middle], latitude[middle], 0.0, 1000.0)
    dx, dy = np.array(to_map.transform(east, north)) - [x[middle], y[middle]]
    turn = np.arctan2(dx, dy)
    c, s = np.cos(turn), np.sin(turn)
    turned = velocity @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([x, y, height]), turned
