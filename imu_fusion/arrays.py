"""For notebooks: arrays or pandas in, structured arrays or pandas out.

>>> rows = orientation(t, gyr, acc, mag)
>>> rows["quat_world_imu"], rows["cov_attitude"]
>>> to_dataframe(rows).plot("time", ["roll_deg", "pitch_deg", "yaw_deg"])
"""

import dataclasses
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.errors import SampleError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.geometry.rotation_arrays import rpy_angles
from imu_fusion.samples import ImuLog, MagLog
from imu_fusion.samples.checks import check_imu, check_mag
from imu_fusion.samples.guard import usable_part
from imu_fusion.samples.logs import Log

if TYPE_CHECKING:
    import pandas

_AXES = {3: "xyz", 4: "xyzw"}    # of vectors and of quaternions
_MANY = 1e14    # stamps above are ns since 1970, seconds never


def orientation(t: ArrayLike, gyr: ArrayLike, acc: ArrayLike, mag: ArrayLike | None = None,
                params: OrientationParams | None = None) -> np.ndarray:
    """The orientation of one sensor, from whole arrays or columns of a pandas frame.

    Samples that are not finite or whose time does not increase are left out; what looks wrong with
    the others (units, axes) is a warning.

    Args:
        t: (n,) s, or ns since 1970 as integers or datetime64.
        gyr: (n, 3) rad/s.
        acc: (n, 3) m/s^2, specific force: +g up at rest.
        mag: (n, 3) tesla, NaN in rows without a reading, or None.
        params: of the estimator; None: its defaults in mode ``smoothed``, which uses every sample
            for every row.

    Returns:
        structured array (:data:`.rows.ORIENTATION_DTYPE`), a row for each usable sample:
        ``quat_world_imu`` (4,) xyzw from the sensor's axes to east-north-up, ``cov_attitude``
        (3, 3) rad^2 in the sensor's axes, corrected ``gyr`` and ``acc``, and more.

    Raises:
        SampleError: shapes that do not fit, or no usable sample.
        EstimationError: no orientation can be found.
    """
    stamp = _stamps(t)
    imu, texts = usable_part(ImuLog(stamp, np.asarray(gyr, float), np.asarray(acc, float)), "imu")
    if not len(imu):
        raise SampleError(f"none of {len(stamp)} samples is usable: all have values that are not "
                          "finite, or times that do not increase")
    texts += [finding.text for finding in check_imu(imu, "imu")]
    field = None
    if mag is not None:
        whole = MagLog(stamp, np.asarray(mag, float))
        field, _ = usable_part(whole[np.isfinite(whole.mag).all(axis=1)], "mag")
        texts += [finding.text for finding in check_mag(field, "mag")]
    for text in texts:
        warnings.warn(text, stacklevel=2)
    estimator = OrientationEstimator(params or OrientationParams(mode="smoothed"))
    return np.concatenate([estimator.run(imu, field), estimator.finish()])


def to_dataframe(rows: "np.ndarray | Log") -> "pandas.DataFrame":
    """Rows of an estimator, or a log, as a pandas frame.

    Args:
        rows: structured array with a field ``stamp`` (ns), such as :func:`orientation` returns, or
            a log such as :func:`imu_fusion.recordings.logs.read_log` returns.

    Returns:
        frame with ``time`` (s since the first row), ``stamp`` (ns), and a column for each number:
        ``gyr_x``, ``cov_attitude_xy``; of attitudes also ``roll_deg``, ``pitch_deg``, ``yaw_deg``.
    """
    import pandas
    columns = {field.name: getattr(rows, field.name) for field in dataclasses.fields(rows)} \
        if isinstance(rows, Log) else {name: rows[name] for name in rows.dtype.names or ()}
    stamp = columns.pop("stamp")
    frame: dict[str, Any] = {"time": (stamp - stamp[:1]) * 1e-9, "stamp": stamp}
    for name, values in columns.items():
        if not isinstance(values, np.ndarray):    # the name of a frame, or nothing
            continue
        if values.ndim == 1:
            frame[name] = values
        for index in np.ndindex(values.shape[1:]) if values.ndim > 1 else ():
            axes = _AXES.get(values.shape[1], "0123456789")
            frame[f"{name}_{''.join(axes[i] for i in index)}"] = values[(..., *index)]
        if name == "quat_world_imu":
            frame |= dict(zip(("roll_deg", "pitch_deg", "yaw_deg"),
                              np.degrees(rpy_angles(values)).T))
    return pandas.DataFrame(frame)


def _stamps(t):
    """(n,) int64 ns."""
    values = np.asarray(t)
    if values.ndim != 1:
        raise SampleError(f"t has shape {values.shape}, expected (n,)")
    if values.dtype.kind == "M":
        return values.astype("datetime64[ns]").astype(np.int64)
    if values.dtype.kind in "iu" and len(values) and np.abs(values).max() > _MANY:
        return values.astype(np.int64)
    seconds = values.astype(np.float64)
    if not np.isfinite(seconds).all() or np.abs(seconds).max(initial=0.0) > 9e9:
        raise SampleError("t holds values that are no times: give seconds, or ns since 1970 as "
                          "integers or datetime64")
    return np.round(seconds * 1e9).astype(np.int64)
