"""What goes wrong on a hill, one at a time: python -m benchmarks.smoother_stress"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.jumps import HEADER, monte_carlo, moved, write
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.params import Gnss
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.simulation.jump_sensors import EPOCH, GnssErrors, PhoneErrors, record
from imu_fusion.simulation.ski_jump import JumpParams, SkiJump
from imu_fusion.surfaces.file import load_surface, surface_from_mapping

SEEDS = range(20)
TOTAL_SD = np.array([3.0, 3.0, 5.0])


def without_imu(start, stop):
    """Recording -> the same without Imu samples between two times, s."""
    def change(recording):
        t = (recording.imu.stamp - EPOCH) * 1e-9
        keep = (t < start) | (t > stop)
        motion = recording.motion
        motion = dataclasses.replace(motion, **{
            f.name: getattr(motion, f.name)[keep] for f in dataclasses.fields(motion)})
        return dataclasses.replace(recording, imu=recording.imu[keep], motion=motion)
    return change


def surveyed(hill):
    """The hill as a table of points 2 m apart."""
    xi, xl = np.arange(-90.0, 0.1, 2.0), np.arange(0.0, 200.0, 2.0)
    origin = hill.origin
    return surface_from_mapping({
        "type": "hill_table", "azimuth_deg": hill.azimuth_deg, "w": hill.k_point[1],
        "n": hill.k_point[0], "in_run": np.column_stack([xi, hill.in_run(xi)[0]]).tolist(),
        "landing": np.column_stack([xl, hill.landing(xl)[0]]).tolist(),
        "origin": {"latitude": origin.latitude_deg, "longitude": origin.longitude_deg,
                   "height": origin.height}})


def main():
    hill = load_surface("oberstdorf_hs106")
    jump = SkiJump(hill)
    base = SmootherParams()
    lines = [f"{len(SEEDS)} seeds each; columns as in smoother_jump.", "", HEADER]

    def row(name, jump=jump, params=base, surface="same", **options):
        surface = jump.hill if surface == "same" else surface
        scores = monte_carlo(jump, SEEDS, params, surface, **options)
        lines.append(f"| {name} | " + " | ".join(scores.cells()) + " |")
        print(lines[-1], flush=True)

    def turned(angle):
        def initial(recording):
            first = Rotation.from_quat(recording.motion.quat_world_imu[0])
            return (Rotation.from_euler("z", angle, degrees=True) * first).as_quat()
        return initial

    def shifted(by):
        return JumpEvents(EPOCH + int((jump.t_takeoff + by) * 1e9),
                          EPOCH + int((jump.t_touchdown + by) * 1e9))

    row("nothing")
    for angle in (45, 90, 135):
        row(f"initial heading wrong by {angle} deg", initial=turned(angle))
    outliers = GnssErrors(outlier_share=0.08)
    row("8 % GNSS outliers", gnss=outliers)
    row("8 % GNSS outliers, squared loss", gnss=outliers,
        params=base.replace(**{"gnss.loss": "squared", "mag.loss": "squared"}))
    late = GnssErrors(time_offset=0.1)
    row("GNSS 100 ms late, no state", gnss=late)
    with_offset = base.replace(**{"gnss.time_offset_sd": 0.2})
    row("GNSS 100 ms late, state", gnss=late, params=with_offset)
    wander = GnssErrors(position_tau=30.0)
    row("95 % Gauss-Markov GNSS error, white model", gnss=wander)
    states = base.replace(gnss=Gnss(position_error_sd=tuple(np.sqrt(0.95) * TOTAL_SD),
                                    position_error_tau=30.0))
    row("95 % Gauss-Markov GNSS error, states", gnss=wander, params=states)
    row("the same, no hill", gnss=wander, params=states, surface=None)
    filtered = GnssErrors(velocity_tau=1.0)
    row("95 % Gauss-Markov GNSS velocity error, white model", gnss=filtered)
    sd_velocity = np.array(base.gnss.velocity_sd)
    states = base.replace(gnss=Gnss(velocity_error_sd=tuple(np.sqrt(0.95) * sd_velocity),
                                    velocity_error_tau=1.0))
    row("95 % Gauss-Markov GNSS velocity error, states", gnss=filtered, params=states)
    row("that, no hill", gnss=filtered, params=states, surface=None)
    row("events given 0.15 s early", events=shifted(-0.15))
    row("events given 0.15 s late", events=shifted(0.15))
    row("gyroscope clipped at 2.5 rad/s", phone=PhoneErrors(gyr_range=2.5),
        params=base.replace(**{"sensor.gyro_range": (2.5,)}))
    start = jump.t_takeoff + 1.0
    row("no Imu for 0.5 s in flight", change=without_imu(start, start + 0.5))
    row("no GNSS for 1 s in flight", outages=((start, start + 1.0),))
    # The jump happens 1 m above the surface that the smoother is given.
    low = moved(hill, up=-1.0)
    row("sensor 1 m above the surface, no state", surface=low)
    row("sensor 1 m above the surface, state", surface=low,
        params=base.replace(**{"surface.body_height_sd": 1.0}))
    for name, x in (("oberstdorf_hs137", -85.0), ("zakopane_hs140", -85.0),
                    ("engelberg_hs140", -85.0)):
        row(name, jump=SkiJump(load_surface(name), JumpParams(start_x=x)))
    row("surveyed table, points 2 m apart", surface=surveyed(hill))
    row("start 6 m lower", jump=SkiJump(hill, JumpParams(start_x=-72.0)))
    row("phone turned on the body", jump=SkiJump(hill, JumpParams(mount=(2.0, -1.5, 1.0))))
    for rate in (50.0, 400.0):
        k = np.sqrt(rate / 100.0)
        phone = PhoneErrors()
        row(f"sensors at {rate:.0f} Hz, the same noise densities", params=base.replace(
            **{"sensor.mag_noise_sd": k * base.sensor.mag_noise_sd}), phone=phone.replace(
                rate=rate, **{sd: k * getattr(phone, sd) for sd in ("gyr_sd", "acc_sd", "mag_sd")}))
    south = dataclasses.replace(hill, origin=LocalFrame(-36.9, 147.3, 1600.0), azimuth_deg=40.0)
    row("southern hemisphere", jump=SkiJump(south))

    found = []
    for seed in SEEDS:
        r = record(jump.shaken(np.random.default_rng([seed, 1])), np.random.default_rng(seed),
                   gnss=late)
        result = Smoother(with_offset, hill).run(r.imu, r.mag, r.fix, r.velocity)
        found.append(result.states["gnss_time_offset"][0][0, 0])
    lines += ["", f"Delay of 100 ms: found with an RMS error of "
              f"{1e3 * np.sqrt(np.mean(np.square(np.array(found) - 0.1))):.1f} ms."]
    write("smoother_stress", "\n".join(lines))


if __name__ == "__main__":
    main()
