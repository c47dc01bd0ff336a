"""What the innovations say of the noise and of the motion that the parameters describe (numba).

Where they are larger than they should be, sample after sample, something is. Noise, as far as the
accelerometers do not agree on one rigid motion, or if innovations change their signs (Mehra 1970):
jitter of the clock, flexing, ringing. Else the motion is wilder than its densities: see
:mod:`.motion_watch`. That is then taken to be larger, by no more than was seen, until the
innovations fit again: estimates weigh rightly what they have, and say how sure they are. Of data
that fit nothing changes at all: the excess is summed (Page 1954), and has to be more than chance
makes it.
"""

import math

import numpy as np

from imu_fusion.kernels import njit

#: ``noise`` and ``motion``: summed excess of the squares of either kind; ``product`` and ``square``
#: of innovations with those of the sample before, fading; ``grace``: samples for which nothing is
#: judged yet; ``samples`` in which something was taken to be larger, and how much the ``most`` was,
#: as a factor on standard deviations, of each kind; samples after which the angular velocity is
#: ``vague``, see :mod:`.hardly_known_rate`; ``tracked``: see :mod:`.motion_watch`; ``about``,
#: ``score`` and ``information``: see :mod:`.wrong_start`.
ADAPTATION = np.dtype([
    ("noise", "f8"), ("motion", "f8"), ("product", "f8"), ("square", "f8"),
    ("grace", "i8"), ("samples", "i8", 2), ("most", "f8", 2), ("vague", "i8"),
    ("tracked", "f8", (6, 6)), ("about", "f8", 3), ("score", "f8", 3),
    ("information", "f8", (3, 3))],
    align=True)

_EXPECTED = 1.5     # mean square of a channel's innovation that is no excess, in its variances
_CHANCE = 6.0       # summed excess of twelve channels that chance makes once in many days
_SLOWNESS = 20.0    # excess that makes a variance e times larger
_ALTERNATING = -0.15   # correlation of innovations with those before, below which they are noise
GRACE = 30          # samples after a start or a gap, in which linearisation is to blame
_MEMORY = 0.9       # of products, from sample to sample


@njit
def factor(excess):
    """By how much a variance is taken to be larger."""
    return math.exp((excess - _CHANCE) / _SLOWNESS) if excess > _CHANCE else 1.0


@njit
def summed(total, squares, largest, least):
    """The summed excess, at ``least`` that, with the mean ``squares`` of one more sample. What was
    large goes the faster; what comes makes a variance no more than ``largest`` times larger, as was
    seen."""
    excess = squares - _EXPECTED
    if excess < 0.0:
        return max(total + excess * max(1.0, total / _SLOWNESS), least)
    return max(total, min(total + excess, _CHANCE + _SLOWNESS * math.log(max(largest, 1.0))))


@njit
def alternates(adaptation, times):
    """Whether innovations change their signs, so many ``times`` as clearly as noise does."""
    return bool(adaptation.product < times * _ALTERNATING * adaptation.square)


@njit
def note(adaptation, kind, excess):
    """Keep for the remarks how much kind 0, noise, or 1, motion, is taken to be larger."""
    grown = factor(excess)
    if adaptation.grace == 0 and grown > 1.0:
        adaptation.samples[kind] += 1
        adaptation.most[kind] = max(adaptation.most[kind], math.sqrt(grown))


@njit
def follow(adaptation, innovation, last):
    """Keep whether innovations change their signs: of this sample (m,), before any was used, and of
    the one before, ``last`` (m,), which becomes this."""
    product, square = 0.0, 0.0
    for c in range(len(innovation)):
        product += innovation[c] * last[c]
        square += innovation[c] * innovation[c]
        last[c] = innovation[c]
    adaptation.product = _MEMORY * adaptation.product + product
    adaptation.square = _MEMORY * adaptation.square + square


@njit
def adapt(adaptation, squares, contradiction, watched):
    """Take one sample, which was followed.

    Args:
        adaptation: ADAPTATION, changed.
        squares: mean of the squares of its innovations, in units of their variances.
        contradiction: mean square of what no rigid motion explains, in units of the noise of the
            parameters.
        watched: whether it was enough for the motion to be watched; else its innovations tell.
    """
    if adaptation.grace > 0:
        adaptation.grace -= 1
        return
    noise = squares
    if not alternates(adaptation, 1.0):
        noise = min(squares, contradiction / factor(adaptation.noise))
    adaptation.noise = summed(adaptation.noise, noise, noise * factor(adaptation.noise), 0.0)
    if not watched:
        motion = squares / max(noise, 1.0)
        adaptation.motion = summed(adaptation.motion, motion, motion * factor(adaptation.motion),
                                   0.0)
        note(adaptation, 1, adaptation.motion)
    note(adaptation, 0, adaptation.noise)
