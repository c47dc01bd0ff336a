"""Was the angular velocity at the start what it was taken for? Later motion tells (numba).

A steady turn about the vertical feels like rest: between accelerometers its centripetal part
differs by no more than biases and mounting may. A gyroscope tells it; without one only a later
motion about other axes does, by its products with the turn. So what errors of the start make of all
later innovations is followed beside the filter, and these errors are fitted to them (generalised
likelihood ratio: Willsky and Jones 1976).
"""

import math

import numpy as np

from imu_fusion.estimation.acceleration_field.cross_check import turns
from imu_fusion.estimation.acceleration_field.motion_model import (
    ALPHA,
    BIAS,
    OMEGA,
    multiply_transition,
    transition,
)
from imu_fusion.estimation.acceleration_field.params import Initial
from imu_fusion.kernels import njit

_TURNS = 5.0     # times the noise: what turning must make of readings to tell of it
_TOLD = 3.0      # standard deviations that the largest turn must be, to be told from none
_LEFT = 1e-3     # of the squares of the errors, once so little is left nothing is asked any more,
_ENOUGH = 100.0  # or so much is known of each, in (rad/s)^-2
_SURELY = 4.5    # standard deviations of an error that is one,
_SLOW = 0.5      # and rad/s


@njit
def move_on(state, step, phi):
    """Predict the errors of a State over a Step that turns by phi (3,), in place."""
    if _squares(state) > 0.0:
        multiply_transition(state.error, transition(step.dt[0], step.chain, phi))


@njit
def fit_start(state, p, channels, at, work, trace, n, open_states):
    """Take what sample n of a Trace, linearised at the state at (N,), says of the errors; only
    ``open_states`` have learnt from it."""
    left = _squares(state)
    if left == 0.0:
        return
    error, adaptation = state.error, state.adaptation[0]
    known = min(adaptation.information[0, 0], adaptation.information[1, 1],
                adaptation.information[2, 2])
    if left < 3.0 * _LEFT or known > _ENOUGH:
        error[:] = 0.0
        return
    # Else the noise of what it is linearised at would seem to tell of it.
    tells = turns(p, channels, at, _TURNS)
    shown = np.empty(3)
    for c in range(len(channels)):
        total = trace.total[n, c]
        if total == 0.0:
            continue
        shown[:] = 0.0
        for k in range(work.entries[c]):
            h, own = trace.row[n, c, k], error[work.touched[c, k]]
            for i in range(3):
                shown[i] += h * own[i]
        if tells:
            for i in range(3):
                adaptation.score[i] += shown[i] * trace.innovation[n, c] / total
                for j in range(3):
                    adaptation.information[i, j] += shown[i] * shown[j] / total
        for k in range(open_states):
            gain = trace.column[n, c, k] / total
            for i in range(3):
                error[k, i] -= gain * shown[i]


@njit
def _squares(state):
    """Of the errors of the angular velocity, (rad/s)^2."""
    squares = 0.0
    for i in range(3):
        for j in range(3):
            squares += state.error[OMEGA + i, j] ** 2
    return squares


@njit
def turned_unseen(about, score, information):
    """The turn (rad/s) about the unit vector of ``about`` (3,) that must be reckoned with at the
    start, as a standard deviation: any up to that, until motion tells; none where it tells none,
    and what it tells, where that is surely one. Whether motion has told is the second."""
    largest = math.sqrt(about[0] ** 2 + about[1] ** 2 + about[2] ** 2)
    if largest == 0.0:
        return 0.0, True
    known, pull = 0.0, 0.0
    for i in range(3):
        pull += about[i] / largest * score[i]
        for j in range(3):
            known += about[i] * information[i, j] * about[j] / largest ** 2
    if known * largest ** 2 < _TOLD ** 2:
        return largest / math.sqrt(3.0), False
    turn = abs(pull) / known
    return (turn if turn > max(_SLOW, _SURELY / math.sqrt(known)) else 0.0), True


def turn_to_reckon_with(about: np.ndarray, adaptation: np.ndarray | None = None) -> np.ndarray:
    """That turn (3,) rad/s, by what an ADAPTATION, if any, says of it."""
    score, information = (np.zeros(3), np.zeros((3, 3))) if adaptation is None else (
        adaptation["score"], adaptation["information"])
    turn, _ = turned_unseen(about, score, information)
    return about * (turn / max(float(np.linalg.norm(about)), 1e-12))


@njit
def doubt_of_start(state, doubt):
    """What the turn that must be reckoned with makes of the first states, into doubt (18,)."""
    adaptation = state.adaptation[0]
    turn, told = turned_unseen(adaptation.about, adaptation.score, adaptation.information)
    doubt[:] = 0.0
    if turn > 0.0:
        about = adaptation.about
        scale = turn / math.sqrt(about[0] ** 2 + about[1] ** 2 + about[2] ** 2)
        for i in range(BIAS):
            for j in range(3):
                doubt[i] += scale * about[j] * state.error[i, j]
        # As far as that is from none, no linear update tells of it.
        if not told:
            doubt[OMEGA:ALPHA] = scale * about


def start_remarks(adaptation: np.ndarray, initial: Initial, blurred: float) -> list[str]:
    """What an ADAPTATION says of the start. blurred: share of a turn that errors of the mounting
    may make up."""
    score, information, about = (adaptation[name] for name in ("score", "information", "about"))
    advice = ("add a gyroscope (use_gyro: true), or give initial.angular_velocity (initial.mode "
              "given)")
    largest = float(np.linalg.norm(about))
    if largest > 0.0:
        turn, told = turned_unseen(about, score, information)
        if not told:
            return [] if largest < _TOLD * initial.angular_velocity_sd else [
                f"accelerometers alone do not tell rest, as it was taken, from a steady turn about "
                f"the vertical by up to {largest:.2g} rad/s, and no motion since has told; what is "
                f"stated is larger by that: where it may have turned, {advice}"]
        if turn > 0.0:
            return ["the motion says that the body turned by some "
                    f"{turn:.2g} rad/s about the vertical where it was taken for still: what "
                    f"is before it is wrong; {advice}"]
        return []
    if initial.mode == "rest":    # with a gyroscope
        return []
    size, axes = np.linalg.eigh(information)
    told = size > _SURELY ** 2
    size, axes = size[told], axes[:, told]
    off = axes @ (axes.T @ score / size)
    length, spread = float(np.linalg.norm(off)), np.sqrt(np.sum((axes.T @ off) ** 2 / size))
    slow = _SLOW + blurred * float(np.linalg.norm(initial.angular_velocity))
    if length * length > max(slow * length, _SURELY * spread):
        text = ", ".join(f"{value:.1f}" for value in off)
        return [f"the motion says that the body turned by some ({text}) rad/s more than "
                "initial.angular_velocity says: correct it, or raise initial.angular_velocity_sd"]
    return []
