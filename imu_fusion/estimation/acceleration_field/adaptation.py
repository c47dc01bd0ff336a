"""What the innovations say of the noise and of the motion that the parameters describe (numba).

Where they are larger than they should be, sample after sample, something is: noise, if they change
their signs (jitter of the clock, flexing, ringing), else the motion is wilder than its densities
(Mehra 1970). That is then taken to be larger until the innovations fit again: estimates weigh
rightly what they have, and say how sure they are. Of data that fit nothing changes at all: the
excess is summed (Page 1954), and has to be more than chance makes it.
"""

import math

import numpy as np

from imu_fusion.kernels import njit

#: ``noise`` and ``motion``: summed excess of the squares of either kind; ``product`` and ``square``
#: of innovations with those of the sample before, fading; ``grace``: samples for which nothing is
#: judged yet; ``samples`` in which something was taken
#: to be larger, and how much the ``most`` was, as a factor on standard deviations, of each kind.
ADAPTATION = np.dtype([
    ("noise", "f8"), ("motion", "f8"), ("product", "f8"), ("square", "f8"),
    ("grace", "i8"), ("samples", "i8", 2), ("most", "f8", 2)], align=True)

_EXPECTED = 1.5     # mean square of a channel's innovation that is no excess, in its variances
_CHANCE = 6.0       # summed excess of twelve channels that chance makes once in many days
_SLOWNESS = 20.0    # excess that makes a variance e times larger
_LARGEST = 280.0    # excess beyond which nothing grows
GRACE = 30          # samples after a start or a gap, in which linearisation is to blame
_MEMORY = 0.9       # of products, from sample to sample


@njit
def factor(excess):
    """By how much a variance is taken to be larger."""
    return math.exp((excess - _CHANCE) / _SLOWNESS) if excess > _CHANCE else 1.0


@njit
def _summed(total, excess, is_its):
    """The summed excess with that of one more sample; what was large goes the faster."""
    if excess > 0.0:
        return min(total + excess, _LARGEST) if is_its else total
    return max(total + excess * max(1.0, total / _SLOWNESS), 0.0)


@njit
def adapt(adaptation, squares, used, innovation, last):
    """Take one sample: normalised ``squares`` of the innovations of ``used`` channels; innovation
    (m,) before any of them was used, last: (m,) that of the sample before; changed."""
    product, square = 0.0, 0.0
    for c in range(len(innovation)):
        product += innovation[c] * last[c]
        square += innovation[c] * innovation[c]
        last[c] = innovation[c]
    adaptation.product = _MEMORY * adaptation.product + product
    adaptation.square = _MEMORY * adaptation.square + square
    if adaptation.grace > 0:
        adaptation.grace -= 1
        return
    excess = squares / used - _EXPECTED
    is_motion = adaptation.product > 0.3 * adaptation.square
    adaptation.noise = _summed(adaptation.noise, excess, not is_motion)
    adaptation.motion = _summed(adaptation.motion, excess, is_motion)
    for i, grown in enumerate((factor(adaptation.noise), factor(adaptation.motion))):
        adaptation.samples[i] += grown > 1.0
        adaptation.most[i] = max(adaptation.most[i], math.sqrt(grown))
