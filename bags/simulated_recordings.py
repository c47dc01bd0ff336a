"""Topics of the recordings of this folder that are simulated, with their truth."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.messages.convert import (
    fix_message,
    imu_message,
    mag_message,
    pose_message,
    string_message,
    velocity_message,
)
from imu_fusion.messages.layouts import FIX, IMU, MAG, POSE, STRING_TYPE, TWIST
from imu_fusion.simulation.avalanche import Avalanche, AvalancheParams
from imu_fusion.simulation.ball_sensors import EPOCH, LEVER_ARM, record_ball
from imu_fusion.simulation.jump_sensors import record
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, ImpactScene
from imu_fusion.simulation.rigid_body_impact import simulate as simulate_impact
from imu_fusion.simulation.ski_jump import SkiJump
from imu_fusion.surfaces.file import load_surface

# Of all recordings of this folder.
IMU_FRAME = "imu_link"
GNSS_FRAME = "gnss"
WORLD_FRAME = "world"

STANDARD_GRAVITY = 9.80665


def simulated_jump(source):
    """Topics of a simulated ski jump, with its truth; nothing of it was measured."""
    jump = SkiJump(load_surface("oberstdorf_hs106"))
    recording = record(jump, np.random.default_rng(2018))
    imu, mag, fix, velocity = (recording.imu, recording.mag, recording.fix, recording.velocity)
    yield "imu/data_raw", IMU.msgtype, [
        (t, imu_message(t, IMU_FRAME, g, a)) for t, g, a in zip(imu.stamp, imu.gyr, imu.acc)]
    yield "imu/mag", MAG.msgtype, [
        (t, mag_message(t, IMU_FRAME, m)) for t, m in zip(mag.stamp, mag.mag)]
    yield "fix", FIX.msgtype, [
        (t, fix_message(t, GNSS_FRAME, latitude, longitude, height, cov))
        for t, latitude, longitude, height, cov in zip(
            fix.stamp, fix.latitude_deg, fix.longitude_deg, fix.height, fix.cov_enu)]
    yield "fix_velocity", TWIST.msgtype, [
        (t, velocity_message(t, WORLD_FRAME, v, cov)) for t, v, cov in zip(
            velocity.stamp, velocity.vel_world, velocity.cov_world)]
    motion = recording.motion
    yield "reference/pose", POSE.msgtype, [
        (t, pose_message(t, WORLD_FRAME, q, p))
        for t, q, p in zip(imu.stamp, motion.quat_world_imu, motion.position_world)]
    truth = {"length": round(float(jump.length), 4), "flight_time": round(
        float(jump.t_touchdown - jump.t_takeoff), 5)}
    for name, time in (("takeoff", jump.t_takeoff), ("touchdown", jump.t_touchdown)):
        truth[f"{name}_stamp"] = int(imu.stamp[0] + round(time * 1e9))
        at = jump.at(np.array([time]))
        truth[f"{name}_speed"] = round(float(np.linalg.norm(at.vel_world)), 4)
    yield "reference/jump", STRING_TYPE, [(imu.stamp[0], string_message(json.dumps(truth)))]


# As the paper averages its receiver's fixes over minutes.
BALL_FIX_SD = 0.2


def simulated_avalanche(source):
    """Topics of a simulated ball in an avalanche, with its truth; nothing of it was measured.

    Two fixes, of the places where it was laid down and dug out, and velocities there: under the
    snow there is nothing.
    """
    rng = np.random.default_rng(2013)
    avalanche = Avalanche(AvalancheParams(rest=4.0), rng)
    log, motion = record_ball(avalanche, rng), avalanche.motion
    imu, mag = log.imu, log.mag
    yield "imu/data_raw", IMU.msgtype, [
        (t, imu_message(t, IMU_FRAME, g, a)) for t, g, a in zip(imu.stamp, imu.gyr, imu.acc)]
    yield "imu/mag", MAG.msgtype, [
        (t, mag_message(t, IMU_FRAME, m))
        for t, m in zip(mag.stamp, mag.mag.astype(np.float32).astype(np.float64))]
    ends = [0, -1]
    place = motion.position[log.rows[ends]] + BALL_FIX_SD * rng.standard_normal((2, 3))
    cov = BALL_FIX_SD ** 2 * np.eye(3)
    yield "fix", FIX.msgtype, [
        (t, fix_message(t, GNSS_FRAME, *where, cov))
        for t, *where in zip(imu.stamp[ends], *avalanche.origin.to_geodetic(place))]
    yield "fix_velocity", TWIST.msgtype, [
        (t, velocity_message(t, WORLD_FRAME, v, cov)) for t, v, cov in zip(
            log.velocity.stamp, log.velocity.vel_world, log.velocity.cov_world)]
    yield "reference/pose", POSE.msgtype, [
        (t, pose_message(t, WORLD_FRAME, q, p)) for t, q, p in zip(
            imu.stamp, motion.quat[log.rows], motion.position_of(LEVER_ARM)[log.rows])]
    phases = {p.number: EPOCH + round(p.start * 1e9) for p in motion.phases[1:]}
    yield "reference/phases", STRING_TYPE, [(imu.stamp[0], string_message(json.dumps(phases)))]


# A head form that lies still, falls by 0.4 m and is struck off its centre, as config/
# head_four_accelerometers.yaml describes it: readings and their errors are those of its figures.
HEAD = ImpactScene(modulus=1e6, ground=0.27, velocity=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0),
                   quat=tuple(Rotation.from_rotvec([0.35, 0.5, 0.0]).as_quat()), mass=4.5,
                   gravity=STANDARD_GRAVITY)
HEAD_CENTRE = np.array([0.0, 0.0, 0.75])
HEAD_REST = 1000     # samples at 1 kHz


def simulated_head(source):
    """Topics of a simulated blow to a head form, with its truth; nothing of it was measured."""
    rng = np.random.default_rng(2019)
    motion = simulate_impact(HEAD, duration=0.8)
    shape = PAPER_POSITIONS.shape
    axes = PAPER_AXES @ Rotation.from_rotvec(0.02 * rng.standard_normal(shape)).as_matrix()
    felt = motion.readings(PAPER_POSITIONS + 1e-3 * rng.standard_normal(shape), axes)
    still = Rotation.from_quat(motion.quat[0]).inv().apply([0.0, 0.0, STANDARD_GRAVITY])
    felt = np.concatenate([np.broadcast_to(axes @ still, (HEAD_REST, *shape)), felt])
    felt = (felt * (1.0 + 0.01 * rng.standard_normal(shape)) + 0.3 * rng.standard_normal(shape)
            + 0.03 * rng.standard_normal(felt.shape)).astype(np.float32).astype(np.float64)
    stamp = EPOCH + 1_000_000 * np.arange(len(felt))
    for k, name in enumerate(("top", "left", "front", "back")):
        yield f"accelerometers/{name}", IMU.msgtype, [
            (t, imu_message(t, IMU_FRAME, None, a)) for t, a in zip(stamp, felt[:, k])]
    quat = np.concatenate([np.tile(motion.quat[0], (HEAD_REST, 1)), motion.quat])
    place = np.concatenate([np.tile(motion.position[0], (HEAD_REST, 1)), motion.position])
    yield "reference/pose", POSE.msgtype, [
        (t, pose_message(t, WORLD_FRAME, q, p)) for t, q, p in zip(stamp, quat, place)]
    peaks = {name: round(float(np.linalg.norm(values, axis=1).max()), 3) for name, values in (
        ("peak_linear_acceleration", motion.acceleration_body(HEAD_CENTRE)),
        ("peak_angular_velocity", motion.omega))}
    yield "reference/impact", STRING_TYPE, [(stamp[0], string_message(json.dumps(peaks)))]
