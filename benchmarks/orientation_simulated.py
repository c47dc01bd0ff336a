"""Own simulation: motions x sensor errors, defaults."""
import math, sys, time
import numpy as np
from dataclasses import dataclass, replace, field
from scipy.spatial.transform import Rotation
from benchmarks.orientation_sets import Recording, peers, score, ours, _THREE_SIGMA, fit_frames
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate, earth_field, _fade

class Numeric:
    """attitude(t) -> Rotation and position(t): rates and accelerations by differences."""
    def truth(self, t):
        h = 1e-4
        a = self.attitude(t)
        rate = (self.attitude(t - h).inv() * self.attitude(t + h)).as_rotvec() / (2 * h)
        h = 2e-3
        acc = (self.position(t + h) - 2 * self.position(t) + self.position(t - h)) / h ** 2
        return a.as_quat(), rate, self.position(t), acc

def waves(rng, n, lo, hi, count=5):
    f = 2 * np.pi * rng.uniform(lo, hi, (n, count)); ph = rng.uniform(0, 2*np.pi, (n, count))
    a = rng.uniform(.5, 1.5, (n, count)) / math.sqrt(count / 2)
    return lambda t: (a * np.sin(f * np.asarray(t)[:, None, None] + ph)).sum(-1) - (a * np.sin(ph)).sum(-1)

def fade(t, rest, length):
    return _fade(np.asarray(t), rest, length)[0][:, None] if length else np.ones((len(t), 1))

class Arm(Numeric):
    """Robot arm: base yaw, elevation, wrist about sensor; joints smoothed; rest first."""
    def __init__(self, seed, rest=3., speed=1.):
        rng = np.random.default_rng(seed)
        self.w = waves(rng, 4, .03 * speed, .2 * speed); self.rest = rest; self.radius = rng.uniform(.4, .9)
        self.amp = np.array([1.0, .4, .9, .9])
        self.mount = Rotation.random(random_state=rng)
    def joints(self, t):
        return self.amp * self.w(t) * fade(t, self.rest, 2.)
    def attitude(self, t):
        j = self.joints(t)
        return Rotation.from_euler("ZYXY", j, degrees=False) * self.mount if False else Rotation.from_euler("ZY", j[:, :2]) * Rotation.from_euler("XY", j[:, 2:]) * self.mount
    def position(self, t):
        j = self.joints(t)
        return Rotation.from_euler("ZY", j[:, :2]).apply([self.radius, 0, 0])

class Carousel(Numeric):
    """Rest, then leaning circles: constant rate for a minute, lean as balanced (scooter) or none."""
    def __init__(self, seed, rest=3., lean=True):
        rng = np.random.default_rng(seed)
        self.rate = rng.uniform(.4, 1.2) * rng.choice([-1, 1]); self.radius = rng.uniform(1.5, 5.)
        self.lean = lean; self.rest = rest
        self.wob = waves(rng, 3, .3, 1.5); self.mount = Rotation.random(random_state=rng)
        while self.rate ** 2 * self.radius > 4: self.radius *= .8
    def angle(self, t):
        T = 4.; s = np.clip((np.asarray(t) - self.rest) / T, 0, None)
        x = np.clip(s, 0, 1); # integral of smoothstep x^3(10-15x+6x^2): x^4(2.5-3x+x^2)
        return self.rate * T * (x**4 * (2.5 - 3*x + x*x) + np.where(s > 1, s - 1, 0))
    def attitude(self, t):
        f = _fade(np.asarray(t), self.rest, 4.)[0]
        w = .03 * self.wob(t) * f[:, None]
        lean = -np.arctan2((self.rate * f) ** 2 * self.radius * np.sign(self.rate), 9.80665) * (1.0 if self.lean else 0.0)
        return Rotation.from_euler("Z", self.angle(t)[:, None]) * Rotation.from_euler("X", lean[:, None]) * Rotation.from_rotvec(w) * self.mount
    def position(self, t):
        a = self.angle(t); s = np.sign(self.rate)
        return self.radius * s * np.column_stack([np.sin(a), -np.cos(a), 0 * a])

class Drone(Numeric):
    """Thrust along z: the force is along body z at all times."""
    def __init__(self, seed, rest=3., size=3.):
        rng = np.random.default_rng(seed)
        self.w = waves(rng, 3, .04, .25); self.amp = size * np.array([1, 1, .3]); self.rest = rest
        self.y = waves(rng, 1, .02, .15); self.v = waves(rng, 3, 2, 8); self.yaw0 = rng.uniform(-3, 3)
    def position(self, t):
        return self.amp * self.w(t) * fade(t, self.rest, 4.) * .5
    def attitude(self, t):
        h = 2e-2
        acc = (self.position(t + h) - 2*self.position(t) + self.position(t - h)) / h**2 + [0, 0, 9.80665]
        z = acc / np.linalg.norm(acc, axis=1)[:, None]
        yaw = self.yaw0 + (1.5 * self.y(t) * fade(t, self.rest, 4.))[:, 0]
        x0 = np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
        y = np.cross(z, x0); y /= np.linalg.norm(y, axis=1)[:, None]
        x = np.cross(y, z)
        return Rotation.from_matrix(np.stack([x, y, z], axis=2)) * Rotation.from_rotvec(.01 * self.v(t) * fade(t, self.rest, 4.))

class Walk(Numeric):
    """Phone on a walker: 1.8 Hz steps, laps of a room, changes of pose."""
    def __init__(self, seed, rest=2.):
        rng = np.random.default_rng(seed)
        self.f = rng.uniform(1.6, 2.1); self.speed = rng.uniform(.9, 1.5); self.r = rng.uniform(1.5, 3.)
        self.swing = waves(rng, 3, .7, 1.1, 3); self.pose = waves(rng, 3, .02, .08); self.rest = rest
        self.amp = rng.uniform(.1, .5); self.mount = Rotation.random(random_state=rng); self.s = rng.choice([-1, 1])
    def along(self, t):
        T = 2.; s = np.clip((np.asarray(t) - self.rest) / T, 0, None); x = np.clip(s, 0, 1)
        return self.speed * T * (x**4 * (2.5 - 3*x + x*x) + np.where(s > 1, s - 1, 0))
    def position(self, t):
        a = self.s * self.along(t) / self.r; f = _fade(np.asarray(t), self.rest, 2.)[0]; w = 2*np.pi*self.f*np.asarray(t)
        radial = self.r + .03 * f * np.sin(w / 2)
        p = np.column_stack([radial*np.cos(a), radial*np.sin(a), f * .035 * np.sin(w)])
        return p
    def attitude(self, t):
        a = self.s * self.along(t) / self.r; f = fade(t, self.rest, 2.)
        return Rotation.from_euler("Z", a[:, None]) * Rotation.from_rotvec(f * (self.amp * self.swing(t) + .4 * self.pose(t))) * self.mount

def building(rng, amount, scale):
    k = rng.normal(0, 1 / scale, (24, 3)); ph = rng.uniform(0, 2*np.pi, (24, 3)); a = rng.normal(0, amount * math.sqrt(2 / 24), (24, 3))
    return lambda p: (a * np.sin((p @ k.T)[:, :, None] + ph)).sum(1)

def record(name, motion, seed, rate=100., duration=60., mag="clean", scale=None, bias=.01, density=3e-4, limit=math.inf,
           cut=0., place=(.1, 1.), acc_scale=.003, acc_bias=.03, matrix=None):
    rng = np.random.default_rng(1000 + seed)
    s = .005 if scale is None else scale
    gm = np.eye(3) + (rng.normal(0, s, (3, 3)) if scale is None else np.diag(rng.uniform(.7, 1.3, 3) * s * rng.choice([-1, 1], 3)) + rng.normal(0, .003, (3, 3)))
    sensors = Sensors(gyr_density=density, acc_density=2e-3, mag_sd=4e-7, gyr_bias=tuple(rng.normal(0, bias, 3)), gyr_matrix=gm,
                      gyr_walk=2e-5, acc_bias=tuple(rng.normal(0, acc_bias, 3)), mag_offset=tuple(rng.normal(0, 5e-7, 3)), gyr_limit=limit)
    norm = 48e-6
    field = earth_field(norm, math.radians(65))
    imu, m, truth, _ = simulate(motion, duration, rate=rate, sensors=sensors, field_world=field, seed=seed)
    imu = ImuLog(imu.stamp, imu.gyr, imu.acc @ (np.eye(3) + np.diag(rng.normal(0, acc_scale, 3))))
    if limit < math.inf:   # behind a calibration
        c = np.eye(3) + rng.normal(0, .004, (3, 3))
        imu = ImuLog(imu.stamp, imu.gyr @ c.T + rng.normal(0, 2e-3, imu.gyr.shape), imu.acc)
    if mag == "building":
        b = building(rng, *place)
        q, _, p, _ = motion.truth(m.stamp * 1e-9)
        m = MagLog(m.stamp, m.mag + norm * Rotation.from_quat(q).inv().apply(b(p)))
    k = int(cut * rate)
    quat = np.asarray(truth.quat_world_imu)
    # simulate's quat at stamps
    r = Recording(name, imu[k:], None if mag == "none" else m[k:], quat[k:], np.arange(len(quat) - k) > (0 if cut else 2 * rate), "yaw" if mag == "none" else "")
    return r

def evaluate(r, mode, changes=None):
    quat, cov = ours(r, mode, {"declination_deg": 0.0, **(changes or {}), **CH})
    s = score(r, quat, cov)
    ref = fit_frames(quat, r)
    keep = r.mask
    est = Rotation.from_quat(quat[keep]); err = (est * Rotation.from_quat(ref[keep]).inv()).as_rotvec()
    turn = est.as_matrix(); world = turn @ cov[keep] @ turn.transpose(0, 2, 1)
    e2, c2 = err[:, :2], world[:, :2, :2]
    d2 = np.einsum("ni,ni->n", e2, np.linalg.solve(c2, e2[..., None])[..., 0]) 
    hz = err[:, 2] ** 2 / world[:, 2, 2]
    return s, float(d2.mean() / 2), float((d2 < 11.83).mean()), float(hz.mean())

import os, json
CH = json.loads(os.environ.get("OC", "{}"))
CASES = {}
def case(name, **k): CASES[name] = k
for mag in ("none", "clean", "building"):
    case(f"tumble {mag}", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag)
    case(f"arm {mag}", motion=lambda s: Arm(s), mag=mag)
    case(f"arm fast {mag}", motion=lambda s: Arm(s, speed=3), mag=mag)
    case(f"walk {mag}", motion=lambda s: Walk(s), mag=mag)
    case(f"drone {mag}", motion=lambda s: Drone(s), mag=mag)
    case(f"circles lean {mag}", motion=lambda s: Carousel(s), mag=mag, duration=90)
    case(f"circles flat {mag}", motion=lambda s: Carousel(s, lean=False), mag=mag, duration=90)
for sc in (.01, .02, .04, .08):
    for m, f in (("tumble", lambda s: Tumbling(seed=s, rate_sd=1.5)), ("arm fast", lambda s: Arm(s, speed=3)), ("walk", Walk)):
        case(f"{m} none scale {sc}", motion=f, mag="none", scale=sc)
    case(f"tumble clean scale {sc}", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag="clean", scale=sc)
for mag in ("none", "clean"):
    case(f"tumble {mag} density .01", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag, density=.01)
    case(f"arm {mag} density .01", motion=lambda s: Arm(s), mag=mag, density=.01)
    case(f"tumble {mag} 40 Hz", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag, rate=40.)
    case(f"walk {mag} 40 Hz", motion=Walk, mag=mag, rate=40.)
    case(f"tumble {mag} 40 Hz cut", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag, rate=40., cut=10.)
    case(f"tumble {mag} cut", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag, cut=10.)
    case(f"walk {mag} cut", motion=Walk, mag=mag, cut=10.)
    case(f"arm {mag} bias .05 cut", motion=lambda s: Arm(s), mag=mag, bias=.05, cut=10.)
    for lim, sd in ((6., 4.), (15., 8.), (35., 18.)):
        case(f"clip {lim:.0f} {mag}", motion=lambda s, sd=sd: Tumbling(seed=s, rate_sd=sd, frequencies=(.2, 2.)), mag=mag, limit=lim, rate=150.)
    case(f"tumble {mag} acc bias .2", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag=mag, acc_bias=.2, acc_scale=.02)
case("tumble building cut", motion=lambda s: Tumbling(seed=s, rate_sd=1.5), mag="building", cut=10.)
case("walk building cut", motion=Walk, mag="building", cut=10.)

if __name__ == "__main__":
    want = [a for a in sys.argv[1:] if not a.startswith("-")]
    seeds = range(4)
    for name, k in CASES.items():
        if want and name not in want: continue
        k = dict(k); motion = k.pop("motion")
        out = {m: [] for m in ("causal", "smoothed")}; pp = []
        for s in seeds:
            r = record(name, motion(s), s, **k)
            if "-nopeer" not in sys.argv: pp.append(peers(r))
            for m in out: out[m].append(evaluate(r, m))
        for m, peer in (("causal", "VQF"), ("smoothed", "OfflineVQF")):
            ss = [o[0] for o in out[m]]
            po = [p[peer].total for p in pp] or [np.nan]
            mean = lambda part: np.mean([getattr(x, part) for x in ss])
            print(f"{name:28s} {m[:6]} peer {np.mean(po):6.2f} ours {mean('total'):6.2f} i{mean('inclination'):5.2f} h{mean('heading'):6.2f} r{mean('total')/np.mean(po):5.2f} in {mean('within'):.2f} "
                  f"min {min(x.within for x in ss):.2f} tilt nees {np.mean([o[1] for o in out[m]]):6.2f} x{np.median([x.tilt_ratio for x in ss]):4.1f} head nees {np.mean([o[3] for o in out[m]]):5.2f} x{np.median([x.heading_ratio for x in ss]):4.1f}", flush=True)
