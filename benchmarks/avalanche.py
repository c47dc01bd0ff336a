"""The avalanche ball, simulated, with its truth: python -m benchmarks.avalanche [SEEDS [WHOLE]]

WHOLE: of how many seeds the 70 s are smoothed, too (minutes each).
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyproj
from scipy.spatial.transform import Rotation

from benchmarks.avalanche_bound import FIX_SD, least_error
from benchmarks.avalanche_calibrations import calibration_errors
from benchmarks.table import write_table
from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, central_force, dead_reckon
from imu_fusion.estimation.avalanche.in_situ import Constraint, calibrate_in_situ
from imu_fusion.estimation.avalanche.phases import NAMES, find_phases
from imu_fusion.estimation.avalanche.track import TrackParams, track_ball
from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.recovered import recover
from imu_fusion.estimation.smoother import Smoother
from imu_fusion.evaluation.consistency import nees
from imu_fusion.parameters.file import parameters_for
from imu_fusion.samples.logs import FixLog
from imu_fusion.samples.motion_span import find_motion
from imu_fusion.sensors.magnetometer_calibration import calibrate_magnetometer
from imu_fusion.simulation.avalanche import Avalanche, AvalancheParams
from imu_fusion.simulation.ball_sensors import AVANODE, LEVER_ARM, BallErrors, record_ball
from imu_fusion.streams.orientation_messages import OrientationOutputParams
from imu_fusion.streams.smoother import recovery_params
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams
from imu_fusion.streams.stream import EstimatorNodeParams
from imu_fusion.surfaces.file import load_surface

PRESET = Path(__file__).parent.parent / "config" / "avalanche.yaml"
SEEDS, WHOLE_SEEDS = 50, 12
END = 8.99            # s, where the paper ends, before the gap
TERRAIN_SD = 5.0      # m, of a start that is a point of the terrain
FEW = 12              # seeds of the rows that have their own recordings
FRESH = BallErrors(acc_matrix_sd=0.002, acc_bias_sd=0.02)
EXACT = BallErrors(gyr_bias_sd=0.0, gyr_matrix_sd=0.0, gyr_calibration_sd=0.0, gyr_range=1e3,
                   gyr_lsb=0.0, acc_bias_sd=0.0, acc_matrix_sd=0.0, acc_lsb=0.0, mag_offset_sd=0.0,
                   mag_matrix_sd=0.0, mag_axes_sd=0.0, gap=(0.0, 0.0))
# What the AvaNode's receiver does while it lies still, as its user would state it.
GNSS = {"gnss.position_error_sd": AVANODE.position_sd, "gnss.position_error_tau": 15.0,
        "gnss.velocity_error_sd": AVANODE.velocity_sd, "gnss.velocity_error_tau": 0.8,
        "gnss.fix_sd": (0.4, 0.4, 1.0), "gnss.velocity_sd": (0.02, 0.02, 0.03),
        "gnss.covariances": False}
GRID_CRS, GRID_STEP = "EPSG:32632", 2.0
HUMP = 6.0            # m
OUTAGES = ((0.3, 2.5), (4.0, 12.0), (30.0, 40.0))    # s since the entrainment, of a receiver
WITHIN = 0.05         # s, of a transition


class Ball:
    """One seed: its truth, its recording, its magnetometer calibrated in situ."""

    def __init__(self, seed, errors=BallErrors(), terrain=AvalancheParams(), **recording):
        self.avalanche = Avalanche(terrain, np.random.default_rng([seed, 0]))
        self.rng = np.random.default_rng([seed, 1])
        self.log = record_ball(self.avalanche, self.rng, errors, **recording)
        self.motion, self.axes = self.avalanche.motion, self.avalanche.slope_axes()
        self.time = self.motion.time[self.log.rows]
        moving = (self.time > 0.0) & (self.time < 69.0)
        self.calibration = calibrate_magnetometer(
            self.log.mag.mag[moving], float(np.linalg.norm(self.log.field_world)))
        self.known = {name: value for name, value in self.calibration.to_parameters().items()
                      if name.startswith("sensor.")}

    def between(self, begin, end):
        return (self.time >= begin) & (self.time < end)


def preset(classes, node):
    return parameters_for(classes, node, PRESET)[0]


def orientation(ball, part):
    """Errors (n, 3) rad, covariances and rows of the preset, smoothed, over a part."""
    params = preset((OrientationParams, OrientationOutputParams, EstimatorNodeParams),
                    "orientation_estimator")
    field = ball.log.field_world
    params = params.replace(**{**ball.known, "mode": "smoothed", "declination_deg": float(
        np.degrees(np.arctan2(field[0], field[1])))})
    estimator = OrientationEstimator(params)
    rows = np.concatenate([estimator.run(ball.log.imu, ball.log.mag), estimator.finish()])
    error = (Rotation.from_quat(rows["quat_world_imu"]).inv()
             * Rotation.from_quat(ball.motion.quat[ball.log.rows])).as_rotvec()
    return error[part], rows["cov_attitude"][part], rows


def paper(ball):
    """Rows of the paper's method: name -> RMS of position (3), velocity (3), initial direction."""
    result = track_ball(ball.log.imu, ball.log.mag, load_surface("fluela_plane"),
                        ball.log.field_world, ball.avalanche.gravity, TrackParams(duration=END))
    begin = ball.log.imu.stamp[result.motion.start] - ball.log.imu.stamp[0]
    first = int(round(begin * 1e-9 * 1500))
    rows = first + np.round(result.samples.time * 1500).astype(int)
    moved = (ball.motion.position[rows] - ball.motion.position[rows[0]]) @ ball.axes
    velocity = ball.motion.vel[rows] @ ball.axes
    flight = int(np.searchsorted(result.samples.time, ball.motion.phases[3].start))

    def errors(track):
        place = track.position @ ball.axes
        return np.concatenate([
            rms(place - moved), rms(track.vel @ ball.axes - velocity),
            [abs(np.degrees(np.arctan2(place[flight, 2], place[flight, 0])
                            - np.arctan2(moved[flight, 2], moved[flight, 0])))]])

    found = {"laboratory calibration": errors(result.track)}
    g = ball.avalanche.gravity
    for level in ("position", "velocity"):
        for model in (1, 2, 3):
            calibration = calibrate_in_situ(result.samples, Constraint(
                result.axes[:, 2], g, level, model))
            found[f"{level}, model {model}, as printed"] = errors(
                dead_reckon(calibration.apply(result.samples), g))
    found["position, model 2, rest and realignment"] = errors(result.improved_track)
    return found


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def recovered(ball):
    """The ball's Imu with its rates recovered, as the preset does it."""
    return recover(ball.log.imu, ball.log.mag, recovery_params(
        preset((SmoothingParams, SmootherNodeParams), "smoother").replace(**ball.known))).imu


def fixes(ball, part, count):
    """FixLog of the first ``count`` of the two ends of a part, each a mean over minutes."""
    place = ball.motion.position[ball.log.rows[part][[0, -1]]]
    place = place + FIX_SD * ball.rng.standard_normal((2, 3))
    latitude, longitude, height = (v[:count] for v in ball.avalanche.origin.to_geodetic(place))
    return FixLog(ball.log.imu.stamp[part][[0, -1]][:count], latitude, longitude, height,
                  np.tile(FIX_SD ** 2 * np.eye(3), (count, 1, 1)), np.zeros(count))


def on_terrain(ball, part):
    """Parameters of a start that nobody has measured: a point of the terrain, TERRAIN_SD off."""
    place = ball.motion.position[ball.log.rows[part][0]] + TERRAIN_SD * ball.rng.standard_normal(3)
    return {"initial.position": tuple(float(v) for v in ball.avalanche.origin.to_geodetic(place)),
            "initial.position_sd": TERRAIN_SD}


def smoother(ball, imu, begin, end, count=2, surface="fluela_plane", gnss=False):
    """RMS (3) of the slope frame, stated (3), NEES of position; attitude: RMS deg, NEES; converged;
    stated of the attitude, deg.

    count: fixes at the ends that are known; 0: none, the start is a point of the terrain. gnss:
    take the receiver's fixes and velocities in their place.
    """
    part = ball.between(begin, end)
    stamps = ball.log.imu.stamp[part][[0, -1]] + [0, 1]
    velocity = ball.log.velocity.between(*stamps)
    given = GNSS if gnss else {} if count else on_terrain(ball, part)
    params = preset((SmoothingParams, SmootherNodeParams), "smoother").replace(
        **{**ball.known, **given})
    fix = ball.log.fix.between(*stamps) if gnss else fixes(ball, part, count) if count else None
    result = Smoother(params, load_surface(surface)).run(
        imu[part], ball.log.mag[part], fix, velocity if count and len(velocity) else None)
    return smoother_score(ball, part, result)


def smoother_score(ball, part, result):
    s, rows = result.samples, ball.log.rows[part]
    error = (s["position_world"] - ball.motion.position_of(LEVER_ARM)[rows]) @ ball.axes
    cov = ball.axes.T @ s["cov_position"] @ ball.axes
    turn = (Rotation.from_quat(s["quat_world_imu"]).inv()
            * Rotation.from_quat(ball.motion.quat[rows])).as_rotvec()
    return np.concatenate([
        rms(error), np.sqrt(cov.diagonal(0, 1, 2).mean(axis=0)), [nees(error, cov).mean()],
        [np.degrees(np.sqrt((turn ** 2).sum(axis=1).mean())),
         nees(turn, s["cov_attitude"]).mean(), float(result.converged),
         np.degrees(np.sqrt(np.trace(s["cov_attitude"], axis1=1, axis2=2).mean()))]])


def grid_file(avalanche, folder):
    """Surface file of the terrain as an elevation grid of GRID_STEP m."""
    crs, back = (pyproj.Transformer.from_crs(a, b, always_xy=True) for a, b in (
        ("EPSG:4979", GRID_CRS), (GRID_CRS, "EPSG:4979")))
    origin = avalanche.origin
    x0, y0 = (GRID_STEP * np.floor(v / GRID_STEP) for v in crs.transform(
        origin.longitude_deg, origin.latitude_deg))
    nodes = GRID_STEP * np.arange(-20, 250)
    x, y = np.meshgrid(x0 + nodes, (y0 + nodes)[::-1])
    longitude, latitude = back.transform(x.ravel(), y.ravel())
    height = np.full(x.size, origin.height)
    for _ in range(3):     # the Earth is not flat
        east, north, _ = origin.to_enu(latitude, longitude, height).T
        _, _, height = origin.to_geodetic(np.column_stack(
            [east, north, avalanche.elevation(east, north)]))
    grid = Path(folder) / "grid.asc"
    head = f"ncols {len(nodes)}\nnrows {len(nodes)}\nxllcenter {x.min()}\nyllcenter {y.min()}\n"
    np.savetxt(grid, height.reshape(x.shape), "%.3f", header=f"{head}cellsize {GRID_STEP}",
               comments="")
    file = Path(folder) / "grid.yaml"
    file.write_text(f"{{type: elevation_grid, file: grid.asc, crs: '{GRID_CRS}', sigma: 0.3, "
                    f"origin: {{latitude: {origin.latitude_deg}, longitude: "
                    f"{origin.longitude_deg}, height: {origin.height}}}}}\n")
    return str(file)


def on_hump(seed):
    """Smoother of a ball on a slope with a convexity, from its elevation grid; the slope frame is
    that of the start."""
    ball = Ball(seed, terrain=AvalancheParams(hump_height=HUMP))
    with TemporaryDirectory() as folder:
        return smoother(ball, recovered(ball), -3.0, END, 2, grid_file(ball.avalanche, folder))


def with_receiver(seed, end, outages):
    """Smoother of a ball with a receiver of 10 Hz, whose fixes and velocities are missing in
    ``outages``."""
    ball = Ball(seed, gnss=AVANODE, gnss_rate=10.0, outages=outages)
    return smoother(ball, recovered(ball), -3.0, end, gnss=True)


def phases(ball, rows):
    """Errors (6,) s of the transitions, nan where one is missing."""
    imu, span = ball.log.imu, find_motion(ball.log.imu)
    part = slice(span.start, span.stop)
    time = ball.time[part] - ball.time[span.start]
    force = central_force(BallSamples(time, rows["quat_world_imu"][part], imu.acc[part],
                                      rows["gyr"][part], LEVER_ARM))
    found = {t.number: t.time + ball.time[span.start] for t in find_phases(
        time, force, rows["gyr"][part], ball.time[min(span.stop, len(imu) - 1)]
        - ball.time[span.start], ball.avalanche.gravity)}
    return np.array([found.get(p.number, np.nan) - p.start for p in ball.motion.phases[1:]])


def at_rest(ball, errors):
    """Mean squares (rad^2) of the error of the most likely attitude that force and field at rest
    show, and of its standard deviation: no estimator without terrain or fixes knows more, since
    nothing tells the turn about the field later on."""
    rows = ball.between(-3.0, -0.2)
    turn = Rotation.from_quat(ball.motion.quat[ball.log.rows[rows][0]])
    mag = (ball.log.mag.mag[rows].mean(axis=0) - ball.calibration.offset) @ ball.calibration.matrix.T
    seen = np.array([ball.log.imu.acc[rows].mean(axis=0), mag])
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    world = np.array([[0.0, 0.0, 1.0], ball.log.field_world / np.linalg.norm(ball.log.field_world)])
    sd = np.array([np.hypot(errors.acc_matrix_sd, errors.acc_bias_sd / ball.avalanche.gravity),
                   errors.mag_axes_sd])
    found, _ = Rotation.align_vectors(world, seen, weights=sd ** -2)
    information = sum((np.eye(3) - np.outer(v, v)) / s ** 2 for v, s in zip(world, sd))
    return [(found.inv() * turn).magnitude() ** 2, np.trace(np.linalg.inv(information))]


def without_errors(seed):
    """Smoother of the whole 70 s where nothing but the noise of the samples errs: calibrations are
    exact, no rate is clipped and none is missing."""
    ball = Ball(seed, EXACT)
    ball.known |= {"sensor.gyro_bias_sd": 1e-5, "sensor.gyro_scale_sd": 0.0,
                  "sensor.acc_matrix_sd": 0.0, "sensor.acc_bias_sd": 1e-5,
                  "sensor.acc_noise_density": 0.03, "sensor.mag_axes_sd": 0.0,
                  "sensor.mag_bias_sd": 1e-9, "sensor.mag_scale_sd": 1e-6,
                  "sensor.mag_noise_sd": 3e-7}
    return smoother(ball, ball.log.imu, -3.0, 73.0)


def attitude_score(ball):
    """Mean squares of error and of what is stated (rad^2), share within 3 sigma, NEES; rows."""
    error, cov, rows = orientation(ball, ball.between(-3.0, END))
    size, variance = np.linalg.norm(error, axis=1), np.trace(cov, axis1=1, axis2=2)
    return [np.mean(size ** 2), np.mean(size < 3.0 * np.sqrt(variance)), variance.mean(),
            nees(error, cov).mean()], rows


def score(seed, whole):
    """Everything of one seed, by name."""
    ball, out = Ball(seed), {}
    out["orientation"], rows = attitude_score(ball)
    out["paper"] = paper(ball)
    out["bound"] = at_rest(ball, BallErrors())
    imu = recovered(ball)
    for name, count in (("end", 2), ("start", 1), ("terrain", 0)):
        out[name] = smoother(ball, imu, -3.0, END, count)
    if seed < FEW:
        out["hump"] = on_hump(seed)
        out["receiver"] = with_receiver(seed, END, ((0.3, 2.5), (4.0, 7.0)))
        fresh = Ball(seed, FRESH)
        out["fresh bound"] = at_rest(fresh, FRESH)
        # As its user knows it, and says.
        fresh.known["sensor.acc_bias_sd"] = float(np.hypot(
            FRESH.acc_bias_sd, FRESH.acc_matrix_sd * fresh.avalanche.gravity))
        out["fresh"] = attitude_score(fresh)[0]
    if seed < whole:
        out["whole"] = smoother(ball, imu, -3.0, 73.0)
        out["exact"] = without_errors(seed)
        out["whole receiver"] = with_receiver(seed, 73.0, OUTAGES)
    out["phases"], out["calibrations"] = phases(ball, rows), calibration_errors(ball)
    print(seed, out["end"].round(2), out["phases"].round(3), flush=True)
    return out


def triple(values, digits=2):
    return "/".join(f"{v:.{digits}f}" for v in values)


def orientation_rows(out):
    """Rows of the orientation estimator, beside what force and field at rest allow."""
    for name, key in (("", ""), (", accelerometer fresh from its calibration", "fresh ")):
        o, bound = np.array(out[key.strip() or "orientation"]), np.array(out[key + "bound"])
        ratio = np.sqrt(o[:, 2] / o[:, 0])
        yield (f"orientation, preset, smoothed{name}: RMS, deg; share within 3 sigma, %; stated over actual (median); NEES",
               f"{np.degrees(np.sqrt(o[:, 0].mean())):.2f}; {100 * o[:, 1].mean():.0f}; "
               f"{np.sqrt(o[:, 2].mean() / o[:, 0].mean()):.2f} ({np.median(ratio):.2f}); {o[:, 3].mean():.1f}",
               "goal 1; 97 to 100; .7 to 1.6")
        found, expected = np.degrees(np.sqrt(bound.mean(axis=0)))
        yield (f"the same at rest, by force and field with the errors that they have{name}: RMS, deg; expected of the best estimator (Cramér-Rao), deg",
               f"{found:.2f}; {expected:.2f}",
               "later only terrain and fixes tell the turn about the field: see the smoother's attitude")


def report(seeds, count):
    """Rows of the table: what, measured, goal or what the paper says."""
    out = {key: [s[key] for s in seeds if key in s] for key in seeds[0]}
    whole, rows = len(out.get("whole", ())), list(orientation_rows(out))
    said = {"laboratory calibration": "6 deg off in the vertical section (Fig. 13)",
            "position, model 1, as printed": "does not work properly (Fig. 17)",
            "position, model 2, as printed": "preferred",
            "position, model 3, as printed": "virtually identical to 2",
            "velocity, model 1, as printed": "does not work properly (Fig. 17)",
            "velocity, model 2, as printed": "similar, less robust",
            "velocity, model 3, as printed": "virtually identical to 2"}
    for name in out["paper"][0]:
        s = np.array([p[name] for p in out["paper"]])
        s = np.sqrt(np.mean(s ** 2, axis=0))
        rows.append((f"paper's method, {name}: position long/lat/transverse, m; velocity, m/s; initial direction, deg",
                     f"{triple(s[:3])}; {triple(s[3:6])}; {s[6]:.1f}", said.get(name, "not in the paper; goal transverse .3 m, 1 deg")))
    for key, name, goal in (
            ("end", f"smoother, start and end known, to {END:.0f} s", "goal .5/.8/.15, NEES 2 to 4, 2 to 4"),
            ("start", f"smoother, start only, to {END:.0f} s", "stated; NEES 2 to 4"),
            ("terrain", f"smoother, no fix: the start is a point of the terrain, known to {TERRAIN_SD:.0f} m, to {END:.0f} s", "stated; NEES 2 to 4"),
            ("hump", f"smoother, start and end known, over a hump of {HUMP:.0f} m by its elevation grid, to {END:.0f} s", "not in the paper"),
            ("receiver", f"smoother, 10 Hz fixes with velocities, none for 5.2 of {END:.0f} s", "not in the paper"),
            ("whole", f"smoother, start and end known, 70 s through the gap ({whole} seeds)", "goal .5/.8/.15, NEES 2 to 4, 2 to 4"),
            ("exact", f"the same where nothing but noise errs: no gap, no clipping, exact calibrations ({whole} seeds)", "what the noise alone allows"),
            ("whole receiver", f"the same, 10 Hz fixes with velocities, none for 20 of 70 s ({whole} seeds)", "not in the paper")):
        if key not in out:
            continue
        s = np.array(out[key])
        mean = np.sqrt(np.mean(s[:, :6] ** 2, axis=0))
        rows.append((f"{name}: position, m (stated); NEES (median); attitude, deg (stated); NEES (median); converged",
                     f"{triple(mean[:3])} ({triple(mean[3:])}); {s[:, 6].mean():.1f} ({np.median(s[:, 6]):.1f}); "
                     f"{np.sqrt(np.mean(s[:, 7] ** 2)):.2f} ({np.sqrt(np.mean(s[:, 10] ** 2)):.2f}); "
                     f"{s[:, 8].mean():.1f} ({np.median(s[:, 8]):.1f}); "
                     f"{s[:, 9].mean():.2f}", goal))
    rows.append(("bound of the 70 s between known ends, attitude and constants of the sensors known, only the "
                 "accelerometer's samples noisy: along one axis, m; with the gap",
                 f"{least_error((0.0, 0.0)):.2f}; {least_error(BallErrors().gap):.2f}",
                 "no estimator does better; goal .5/.8"))
    p = np.abs(np.array(out["phases"]))
    hits = np.mean(p < WITHIN, axis=0)
    rows.append((f"phases within {WITHIN} s, % of seeds: " + ", ".join(NAMES[1:]),
                 ", ".join(f"{100 * h:.0f}" for h in hits) + f"; all {100 * hits.mean():.0f}",
                 "goal 95"))
    for k, name in enumerate(("magnetometer in situ: offsets", "accelerometer on six sides: matrix and bias",
                              "gyroscope by twelve half turns: matrix and bias")):
        m = np.abs(np.array([s[k] for s in out["calibrations"]]))
        rows.append((f"{name} within 3 sigma, % of parameters", f"{100 * np.mean(m < 3):.0f}", "goal 95"))
    write_table("avalanche", ("what", "measured", "goal, or what the paper says"), rows,
                f"Simulated balls on a plane of 32 deg, {count} seeds (fresh accelerometer, hump, receiver: "
                f"{len(out['fresh'])}): errors of `imu_fusion.simulation.ball_sensors`, among them 3 % of the "
                "accelerometer's matrix. Fresh: 0.2 % and 0.02 m/s^2, and sensor.acc_bias_sd says so. RMS over samples and seeds; NEES: 3 is "
                f"ideal. Fixes of the start and the end: {FIX_SD} m.")


def main(count=SEEDS, whole=WHOLE_SEEDS):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        done = []
        for one in pool.map(partial(score, whole=whole), range(count)):
            done.append(one)
            report(done, len(done))     # the table so far: each seed takes a while


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
