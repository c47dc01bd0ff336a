"""Every kernel compiled, or found in the cache, before anybody waits for it.

``imu_fusion compile`` runs each estimator on a few seconds of made-up samples, in processes side
by side. Setups, the launch file and whoever starts several nodes call it first: a node that
compiles while others wait for it looks like one that hangs.
"""

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from imu_fusion import kernels
from imu_fusion.errors import ImuFusionError
from imu_fusion.signals import LEASH, end_with_parent, held

_STEP = 10_000_000     # ns
_SAMPLES = 400
_EPOCH = 1_700_000_000_000_000_000    # ns: the World Magnetic Model knows this year


def _orientation() -> None:
    from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
    from imu_fusion.samples.flat_tops import GYRO_FLOOR, flat_tops

    imu, mag = _logs()
    # Both methods are one kernel.
    for params in (OrientationParams(), OrientationParams(mode="smoothed")):
        estimator = OrientationEstimator(params)
        estimator.run(imu, mag)
        estimator.finish()
        if params.mode == "causal":
            estimator.reset()
            for i in range(_SAMPLES):
                estimator.add_mag(int(mag.stamp[i]), mag.mag[i])
                estimator.add_imu(int(imu.stamp[i]), imu.gyr[i], imu.acc[i])
            estimator.finish()
    # What looks at recordings before they are estimated.
    flat_tops(np.clip(3.0 * imu.gyr, -2.0, 2.0), GYRO_FLOOR)
    _orientation_messages(imu, mag)


def _orientation_messages(imu, mag) -> None:
    """What turns rows into messages."""
    from imu_fusion.estimation.orientation.params import OrientationParams
    from imu_fusion.messages.convert import imu_message, mag_message
    from imu_fusion.streams.orientation import OrientationStream
    from imu_fusion.streams.orientation_messages import OrientationOutputParams

    stream = OrientationStream(OrientationParams(),
                               OrientationOutputParams(remove_gravity_vector=True))
    stream.take({
        "imu/data_raw": [imu_message(int(s), "imu_link", g, a)
                         for s, g, a in zip(imu.stamp, imu.gyr, imu.acc)],
        "imu/mag": [mag_message(int(s), "imu_link", m) for s, m in zip(mag.stamp, mag.mag)]})
    stream.finish()


def _smoother() -> None:
    from imu_fusion.estimation.smoother import Smoother, SmootherParams
    from imu_fusion.geometry.geodesy import LocalFrame
    from imu_fusion.samples import FixLog, VelocityLog
    from imu_fusion.surfaces.plane import Plane

    imu, mag = _logs()
    stamp = imu.stamp[::20]
    nothing = np.zeros(len(stamp))
    fix = FixLog(stamp, nothing + 47.0, nothing + 11.0, nothing + 500.0,
                 np.tile(np.eye(3), (len(stamp), 1, 1)), nothing.astype(np.int64))
    velocity = VelocityLog(stamp, np.zeros((len(stamp), 3)), np.tile(np.eye(3), (len(stamp), 1, 1)))
    plane = Plane(LocalFrame(47.0, 11.0, 500.0), 0.0, 0.0, 0.1)
    for method, surface in (("iterated", None), ("iterated", plane), ("extended_rts", None)):
        Smoother(SmootherParams(method=method), surface).run(imu, mag, fix, velocity)
    # Held on the surface from the first pass on.
    recovered = replace(imu, gyr_sd=np.full_like(imu.gyr, 0.01))
    Smoother(SmootherParams(), plane).run(recovered, mag, fix, velocity)


def _acceleration_field() -> None:
    from imu_fusion.geometry.rotation_arrays import rotation_matrices
    from imu_fusion.streams.acceleration_field import FieldConfiguration, messages

    imu, _ = _logs()
    places = {"a": [0.1, 0.0, 0.0], "b": [0.0, 0.1, 0.0], "c": [0.0, 0.0, 0.1],
              "d": [-0.1, -0.1, 0.0]}
    readings = np.repeat(imu.acc[:, None], len(places), axis=1)
    array = {"sample_rate": 100.0, "accelerometers.names": list(places), "points": [0.0] * 3,
             **{f"accelerometers.{name}.position": place for name, place in places.items()}}
    for values, gyr in (({}, None), ({"mode": "smoothed"}, None), ({"method": "ao"}, None),
                        ({"method": "sqrt_ao"}, None),
                        ({"use_gyro": True}, imu.gyr)):
        config = FieldConfiguration.from_mapping(array | values)
        estimator = config.make_estimator()
        rows = estimator.run(imu.stamp, readings, gyr)
        rotation_matrices(rows["quat"])
        messages(config, rows)
        if values.get("mode") != "smoothed":
            estimator.reset()
            for i in range(_SAMPLES):
                estimator.add(int(imu.stamp[i]), readings[i], None if gyr is None else gyr[i])


_JOBS: dict[str, Callable[[], None]] = {
    "orientation": _orientation, "smoother": _smoother, "acceleration_field": _acceleration_field}


def _logs():
    """Samples at rest, then turned back and forth, without noise."""
    from imu_fusion.samples import ImuLog, MagLog

    since = np.arange(_SAMPLES, dtype=np.int64) * _STEP
    t = np.maximum(since * 1e-9 - 2.0, 0.0)
    ones = np.ones((_SAMPLES, 1))
    gyr = np.stack([np.sin(3.0 * t), np.sin(4.0 * t), np.sin(5.0 * t)], axis=1)
    stamp = since + _EPOCH
    return (ImuLog(stamp, gyr, ones * [0.0, 0.0, 9.81]),
            MagLog(stamp, ones * [0.0, 2e-5, -4e-5]))


def compile_ahead(say: Callable[[str], object]) -> None:
    """Compile what is not in the cache yet; returns at once where everything is.

    Args:
        say: called with one line of text if something has to be compiled.

    Raises:
        ImuFusionError: a kernel does not compile here; with the last words of the compiler.

    What raises an exception in the meantime ends the processes, too.
    """
    mark = kernels.cache_file(f"complete-{_state()}")
    if mark is None or mark.exists():
        return
    say(kernels.NOTICE)
    processes: dict[str, subprocess.Popen] = {}
    try:
        with held():
            for job in _JOBS:
                processes[job] = subprocess.Popen(
                    [sys.executable, "-m", "imu_fusion.compile_ahead", job], text=True,
                    env=os.environ | LEASH, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT)
        for job, process in processes.items():
            assert process.stdout is not None
            said = process.stdout.read()    # communicate() would close the leash
            if process.wait():
                raise ImuFusionError(f"the kernels of {job} do not compile here: "
                                     + " | ".join(said.strip().splitlines()[-3:]))
    finally:
        _end(processes.values())
    mark.touch()


def _end(processes: Iterable[subprocess.Popen]) -> None:
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + 5.0
    for process in processes:
        try:
            process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _state() -> str:
    """A digest of the sources of this package, of numba and of the processor."""
    package = Path(kernels.__file__).parent
    digest = hashlib.sha256((kernels.versions() + kernels.processor()).encode())
    for file in sorted(package.rglob("*.py")):
        digest.update(str(file.relative_to(package)).encode() + file.read_bytes())
    return digest.hexdigest()[:24]


if __name__ == "__main__":
    end_with_parent()
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    _JOBS[sys.argv[1]]()
