"""Time per sample of every method, beside the paper in plain numpy.

    python -m benchmarks.acceleration_field_speed
"""

import os
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmarks.acceleration_field_cases import METHODS, PARAMS, noisy, paper_sensors
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import AccelerometerParams, Sensor
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

SAMPLES = 5001


def plain_paper(t, readings, positions, axes, omega):
    """Rahaman 2019, eq. (3.4)-(3.17), sample by sample in plain numpy: the peer."""
    differences = (positions[1:] - positions[0]).T
    inverse = np.linalg.inv(differences)
    turn = np.eye(3)
    out, before = [], None
    for n in range(len(t)):
        body = np.array([a.T @ r for a, r in zip(axes, readings[n])])
        gradient = (body[1:] - body[0]).T @ inverse
        value = body[0] - gradient @ positions[0]
        rate = 0.5 * (gradient - gradient.T)
        alpha = np.array([rate[2, 1], rate[0, 2], rate[1, 0]])
        if before is not None:
            h = t[n] - t[n - 1]
            v = h * (omega + 0.5 * h * before)
            angle = np.linalg.norm(v)
            k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
            turn = turn @ (np.eye(3) + np.sinc(angle / np.pi) * k
                           + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * k @ k)
            omega = omega + 0.5 * h * (before + alpha)
        before = alpha
        out.append(turn @ value)
    return np.array(out)


def case():
    motion = simulate(duration=(SAMPLES - 1) * 1e-3)
    clean = motion.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration")
    return motion, noisy(clean, 10, np.random.default_rng(0))


def _time(call, repeats=3):
    best = np.inf
    for _ in range(repeats):
        begin = time.process_time()
        call()
        best = min(best, time.process_time() - begin)
    return best


def cold(change):
    """Seconds of a first run in a fresh process with an empty compilation cache."""
    code = ("import time; from benchmarks.acceleration_field_speed import *; m, r = case(); "
            "b = time.process_time(); "
            f"AccelerationFieldEstimator(PARAMS.replace(**{change!r}), paper_sensors(10)).run("
            "m.stamp, r); print(time.process_time() - b)")
    with tempfile.TemporaryDirectory() as folder:
        return float(subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True,
            env={**os.environ, "NUMBA_CACHE_DIR": folder}).stdout.split()[-1])


def main():
    """Write the table."""
    motion, readings = case()
    peer = _time(lambda: plain_paper(motion.t, readings, PAPER_POSITIONS, PAPER_AXES,
                                     np.full(3, 5.0)))
    table = [["paper, plain numpy", f"{1e6 * peer / SAMPLES:.1f}", "1", "", ""]]
    for name, change in METHODS.items():
        params = PARAMS.replace(**change)

        def make(params=params):
            return AccelerationFieldEstimator(params, paper_sensors(10))

        make().run(motion.stamp, readings)
        warm = _time(lambda make=make: make().run(motion.stamp, readings))

        def live(make=make):
            estimator = make()
            for stamp, sample in zip(motion.stamp, readings):
                estimator.add(stamp, sample)

        table.append([name, f"{1e6 * warm / SAMPLES:.1f}", f"{peer / warm:.2g}",
                      "" if "mode" in change else f"{1e6 * _time(live, 1) / SAMPLES:.1f}",
                      f"{cold(change):.1f}"])
    for name, change in METHODS.items():
        params = PARAMS.replace(**change, **{f"sensor.{info}": getattr(Sensor(), info) for info in (
            "acc_position_sd", "acc_axes_sd", "acc_scale_sd")})
        if params.method != "rigid_body":
            continue

        def run(params=params):
            AccelerationFieldEstimator(params, paper_sensors(10)).run(motion.stamp, readings)

        run()
        warm = _time(run)
        table.append([f"{name}, mounting and scales by default (1 mm, 2 deg, 1 %)",
                      f"{1e6 * warm / SAMPLES:.1f}", f"{peer / warm:.2g}", "", ""])
    rng = np.random.default_rng(1)
    long = 37_500
    places = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
    sensors = [AccelerometerParams(position=tuple(p)) for p in places]
    samples = rng.normal(0, 0.05, (long, 8, 3)) + [0, 0, 9.80665]
    stamp = np.arange(long) * 16_000_000
    for name, change in METHODS.items():
        params = PARAMS.replace(**{
            "sample_rate": 62.5, "initial.angular_velocity": (0.0, 0.0, 0.0), "gravity": 9.80665,
            **change})
        duration = _time(lambda params=params: AccelerationFieldEstimator(params, sensors).run(
            stamp, samples), 1)
        table.append([f"{name}, 8 accelerometers, 600 s at 62.5 Hz: {duration:.1f} s",
                      f"{1e6 * duration / long:.1f}", "", "", ""])
    write_table("acceleration_field_speed",
                ["method", "us per sample, warm", "times the plain numpy speed",
                 "us per sample, live add()", "first run with compilation, s"], table,
                f"Four accelerometers, {SAMPLES} samples, one core; CPU time, so that other work "
                "on the machine does not count.")


if __name__ == "__main__":
    main()
