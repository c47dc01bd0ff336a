"""The first state: attitude from gravity and the magnetic field, or from a search."""

import numpy as np
from scipy.spatial.transform import Rotation


def attitude_from_vectors(acc, mag, field_world):
    """Attitude from one pair of directions; the force alone fixes the tilt and the field alone
    the heading, as the factored quaternion algorithm of Fang 2020 does (section 4.1).

    Args:
        acc: (3,) specific force, not zero.
        mag: (3,) field in the sensor's axes, or None: then the heading is arbitrary.
        field_world: (3,) east-north-up.

    Returns:
        Quaternion world_imu (4,).
    """
    up = acc / np.linalg.norm(acc)
    if mag is None:
        side = np.eye(3)[np.argmin(np.abs(up))]
        world_side = np.array([1.0, 0.0, 0.0])
    else:
        side = np.cross(mag, up)
        world_side = np.cross(field_world, [0.0, 0.0, 1.0])
        world_side = world_side / np.linalg.norm(world_side)
    side = side - up * (up @ side)
    side = side / np.linalg.norm(side)
    body = np.stack([side, np.cross(up, side), up])
    world = np.stack([world_side, np.cross([0.0, 0.0, 1.0], world_side), [0.0, 0.0, 1.0]])
    return Rotation.from_matrix(world.T @ body).as_quat()


def headings(quat, count):
    """``count`` attitudes (count, 4): ``quat`` turned about the vertical in equal steps."""
    angles = 2.0 * np.pi * np.arange(count)[:, None] / count
    turns = Rotation.from_rotvec(angles * [0.0, 0.0, 1.0])
    return (turns * Rotation.from_quat(quat)).as_quat()
