"""Time and memory of the smoother, beside peers: python -m benchmarks.smoother_speed

A simulated drive in figures of eight: Imu and magnetometer 100 Hz, GNSS 10 Hz. Each run is a
process of its own, so that its memory is its own; peers run in the same session.
"""

import multiprocessing
import os
import resource
import tempfile
import time

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.jumps import write
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.simulation.jump_sensors import EPOCH

FRAME = LocalFrame(47.4, 10.3, 900.0)
FIELD = np.array([1e-6, 21e-6, -43e-6])
SD, SD_VEL = np.array([3.0, 3.0, 5.0]), np.array([0.1, 0.1, 0.3])


def drive(seconds, seed=0):
    """ImuLog, MagLog, FixLog, VelocityLog of figures of eight at some 10 m/s."""
    rng = np.random.default_rng(seed)
    n = int(seconds * 100) + 1
    t = np.arange(n) / 100.0
    w, zero = 0.1, np.zeros(n)
    place = np.stack([100 * np.sin(w * t), 50 * np.sin(2 * w * t), zero], axis=1)
    vel = np.stack([100 * w * np.cos(w * t), 100 * w * np.cos(2 * w * t), zero], axis=1)
    acc = np.stack([-100 * w * w * np.sin(w * t), -200 * w * w * np.sin(2 * w * t), zero], axis=1)
    yaw = np.unwrap(np.arctan2(vel[:, 1], vel[:, 0]))
    rate = (vel[:, 0] * acc[:, 1] - vel[:, 1] * acc[:, 0]) / np.sum(vel ** 2, axis=1)
    body = Rotation.from_rotvec(yaw[:, None] * [0, 0, 1.0]).inv()
    noise = rng.standard_normal((n, 9))
    stamp = EPOCH + np.round(t * 1e9).astype(np.int64)
    gyr = np.stack([zero, zero, rate], axis=1) + 0.01 + 0.0175 * noise[:, :3]
    imu = ImuLog(stamp, gyr=gyr, acc=body.apply(acc + [0, 0, 9.8]) + 0.1 * noise[:, 3:6])
    mag = MagLog(stamp, body.apply(FIELD) + 5e-6 * noise[:, 6:])
    k = np.arange(0, n - 1, 10)
    latitude, longitude, height = FRAME.to_geodetic(
        place[k] + SD * rng.standard_normal((len(k), 3)))
    fix = FixLog(stamp[k], latitude, longitude, height,
                 np.broadcast_to(np.diag(SD ** 2), (len(k), 3, 3)), np.zeros(len(k)))
    velocity = VelocityLog(stamp[k], vel[k] + SD_VEL * rng.standard_normal((len(k), 3)),
                           np.broadcast_to(np.diag(SD_VEL ** 2), (len(k), 3, 3)))
    return imu, mag, fix, velocity


def _measure(seconds, warm, queue):
    if warm:
        Smoother().run(*drive(10))
    logs = drive(seconds)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start, cpu = time.perf_counter(), time.process_time()
    result = Smoother(SmootherParams(gravity=9.8)).run(*logs)
    queue.put((time.perf_counter() - start, time.process_time() - cpu, len(result.cost),
               len(logs[0]), base / 1024,
               resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))


def _alone(target, *args):
    """What ``target`` puts into a queue, its last argument, in a new process."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    child = context.Process(target=target, args=(*args, queue))
    child.start()
    while queue.empty():
        if child.exitcode:
            raise ChildProcessError(f"{target.__name__} ended with {child.exitcode}")
        time.sleep(0.1)
    answer = queue.get()
    child.join()
    return answer


def measure(seconds, warm=True):
    """Wall and CPU s, iterations, samples, MiB before and at most, of a run in a new process."""
    return _alone(_measure, seconds, warm)


def measure_cold(seconds):
    """:func:`measure` of a first call that finds no compiled kernels."""
    with tempfile.TemporaryDirectory() as empty:
        before = os.environ.get("NUMBA_CACHE_DIR")
        os.environ["NUMBA_CACHE_DIR"] = empty
        try:
            return measure(seconds, warm=False)
        finally:
            del os.environ["NUMBA_CACHE_DIR"]
            if before is not None:
                os.environ["NUMBA_CACHE_DIR"] = before


def _measure_node(seconds, queue):
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from std_srvs.srv import Trigger

    from imu_fusion.messages.samples import sample_messages
    from imu_fusion.nodes.smoother import SmootherNode

    def mib(who):
        return resource.getrusage(who).ru_maxrss / 1024

    rclpy.init()
    node, client = SmootherNode(), rclpy.create_node("client")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(client)
    stream = node._stream
    for topic, log in zip(stream.inputs, drive(seconds), strict=True):
        cdrs = sample_messages(log)
        for k in range(0, len(cdrs), 1000):
            stream.take({topic: cdrs[k:k + 1000]})
    del log, cdrs
    collected, before = stream.bytes / 1e6, mib(resource.RUSAGE_SELF)
    service = client.create_client(Trigger, "smoother/smooth")
    future = service.call_async(Trigger.Request())
    start, longest = time.perf_counter(), 0.0

    def turn():
        nonlocal longest
        begun = time.perf_counter()
        executor.spin_once(timeout_sec=min(0.05, node.work()))
        longest = max(longest, time.perf_counter() - begun)

    while not future.done():
        turn()
    answered, longest = time.perf_counter() - start, 0.0
    while node._status()[1] != "collecting":
        turn()
    queue.put((collected, before, mib(resource.RUSAGE_CHILDREN), mib(resource.RUSAGE_SELF),
               answered, time.perf_counter() - start - answered, longest,
               future.result().message))
    node.close()


def measure_node(seconds):
    """Of the smoother node, given a recording of that length: MB collected; MiB of the node
    before, of the child that smooths, of the node at most; s until the answer, then until all
    is published, and the longest time without callbacks meanwhile; the answer."""
    return _alone(_measure_node, seconds)


def paper(seconds):
    """CPU s per sample of the paper's method in numpy (a single pass)."""
    logs = drive(seconds)
    start = time.process_time()
    Smoother(SmootherParams(method="extended_rts")).run(*logs)
    return (time.process_time() - start) / len(logs[0])


def filterpy_pass(seconds):
    """CPU s per sample of one pass of a linear filter and RTS smoother of 21 states, with the
    rows of a magnetometer at each sample."""
    from filterpy.kalman import KalmanFilter
    n = int(seconds * 100)
    kf = KalmanFilter(dim_x=21, dim_z=3)
    kf.F = np.eye(21) + 0.01 * np.eye(21, k=3)
    kf.H = np.eye(3, 21, k=6)
    kf.Q *= 1e-6
    start = time.process_time()
    xs, ps = np.empty((n, 21, 1)), np.empty((n, 21, 21))
    for k in range(n):
        kf.predict()
        kf.update(np.zeros(3))
        xs[k], ps[k] = kf.x, kf.P
    kf.rts_smoother(xs, ps)
    return (time.process_time() - start) / n


def gtsam_pass(seconds):
    """CPU s per Imu sample and iteration of GTSAM: Imu factors preintegrated between fixes,
    positions and biases only, states and marginals at the fixes."""
    import gtsam
    from gtsam.symbol_shorthand import B, V, X
    imu, _, fix, velocity = drive(seconds)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.8)
    params.setAccelerometerCovariance(1e-4 * np.eye(3))
    params.setGyroscopeCovariance(3e-6 * np.eye(3))
    params.setIntegrationCovariance(1e-8 * np.eye(3))
    params.setBiasAccCovariance(1e-10 * np.eye(3))
    params.setBiasOmegaCovariance(1e-10 * np.eye(3))
    place = FRAME.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)
    start = time.process_time()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(SD)
    noise_vel = gtsam.noiseModel.Diagonal.Sigmas(SD_VEL)
    zero = gtsam.imuBias.ConstantBias()
    graph.addPriorConstantBias(B(0), zero, gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
    for i in range(len(fix)):
        v = velocity.vel_world[i]
        yaw = gtsam.Rot3.Yaw(float(np.arctan2(v[1], v[0])))
        values.insert(X(i), gtsam.Pose3(yaw, place[i]))
        values.insert(V(i), v)
        values.insert(B(i), zero)
        graph.add(gtsam.GPSFactor(X(i), place[i], noise))
        graph.addPriorVector(V(i), v, noise_vel)
        if i:
            pim = gtsam.PreintegratedCombinedMeasurements(params, zero)
            for k in range(10 * (i - 1), 10 * i):
                pim.integrateMeasurement(imu.acc[k], imu.gyr[k], 0.01)
            graph.add(gtsam.CombinedImuFactor(X(i - 1), V(i - 1), X(i), V(i), B(i - 1), B(i),
                                              pim))
    built = time.process_time() - start
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    start = time.process_time()
    solution = optimizer.optimize()
    solved = (time.process_time() - start) / max(optimizer.iterations(), 1)
    start = time.process_time()
    marginals = gtsam.Marginals(graph, solution)
    for i in range(len(fix)):
        marginals.marginalCovariance(X(i))
        marginals.marginalCovariance(V(i))
    return built / len(imu), solved / len(imu), (time.process_time() - start) / len(imu)


def main():
    lines = ["Figures of eight, Imu and magnetometer 100 Hz, GNSS 10 Hz, 21 error states; CPU "
             "time on one core, peak memory of the process.", "",
             "| run | samples | iterations | wall s | CPU s | us per sample and iteration "
             "(covariances included) | MiB before, peak |", "|---|---|---|---|---|---|---|"]
    runs = [("10 min, first call, nothing compiled", lambda: measure_cold(600)),
            ("10 min, first call of a process, kernels cached", lambda: measure(600, False)),
            ("10 min, warm", lambda: measure(600)), ("2 h, warm", lambda: measure(7200))]
    measure(10)  # leaves compiled kernels behind, should there be none
    for name, run in runs:
        wall, cpu, iterations, n, before, peak = run()
        # Every iteration is one linear solve, the last one with covariances.
        lines.append(f"| {name} | {n} | {iterations} | {wall:.1f} | {cpu:.1f} | "
                     f"{1e6 * cpu / n / iterations:.1f} | {before:.0f}, {peak:.0f} |")
        print(lines[-1], flush=True)
    lines += ["", "Peers in the same session, 60 s of the drive, CPU us per Imu sample:", "",
              "| | us per sample |", "|---|---|"]
    wall, cpu, iterations, n, *_ = measure(60)
    lines.append(f"| imu_fusion, all {iterations} iterations | {1e6 * cpu / n:.0f} |")
    lines.append(f"| the paper's method in numpy (this package, one pass) | {1e6 * paper(60):.0f} |")
    for name, peer in (("filterpy 21 states, linear, one pass", filterpy_pass),):
        try:
            lines.append(f"| {name} | {1e6 * peer(60):.0f} |")
        except ImportError:
            lines.append(f"| {name} | not installed |")
    try:
        built, solved, marginals = gtsam_pass(60)
        lines.append("| GTSAM, no magnetometer, states at 10 Hz only: building + one iteration + "
                     f"marginals | {1e6 * built:.0f} + {1e6 * solved:.0f} + {1e6 * marginals:.0f} |")
    except ImportError:
        lines.append("| GTSAM | not installed |")
    lines += ["", "The node, with all that it latches (nobody subscribes):", "",
              "| recording | collected MB | node MiB before | child MiB | node MiB at most | s to the "
              "answer | s to publish | longest s without callbacks |", "|---|---|---|---|---|---|---|---|"]
    for name, seconds in (("10 min", 600), ("2 h", 7200)):
        *figures, answer = measure_node(seconds)
        assert "converged" in answer, answer
        lines.append(f"| {name} | " + " | ".join(
            f"{value:.{digits}f}" for value, digits in zip(figures, (0, 0, 0, 0, 1, 1, 2))) + " |")
        print(lines[-1], flush=True)
    write("smoother_speed", "\n".join(lines))


if __name__ == "__main__":
    main()
