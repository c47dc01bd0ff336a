"""Where the fusion kernel keeps its numbers: offsets into state and parameter arrays."""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import state as st

N = es.N
# Float state.
S = st.X_COMMON            # (N,) nominal values, in the order of the error state; attitude unused
COV = S + N                # (N, N)
NORM = COV + N * N         # field norm, tesla; 0 before the first sample
GRAVITY = NORM + 1         # m/s^2
HEADING_VAR = NORM + 2     # rad^2, of a heading that no magnetometer has fixed
ACC_LAST = NORM + 3        # (3,)
MEAN_RATE = NORM + 6       # (3,) low-passed raw rate, for the rest detector
MEAN_FORCE = NORM + 9      # (3,)
MOVE = NORM + 12           # the block being collected
MAG_SUM = MOVE + es.MOVE_SIZE   # (3,) world axes; then lag (3,), offset (9,), matrix (27,)
MAG_ROWS = 42
LIMIT = MAG_SUM + MAG_ROWS  # (3,) gyroscope limits found
REPEATED = LIMIT + 3       # (3,) last value of each axis
ENTRY = REPEATED + 3       # (3,) step with which it was reached
LARGEST = ENTRY + 3        # (3,) largest rate seen
SWAY = LARGEST + 3         # (3,) world acceleration through a leaky integral, m/s
MOTION = SWAY + 3          # mean square of SWAY over the stated velocity's
CHANGE = MOTION + 1        # usual change of the rate from sample to sample, rad/s
HELD_RATE = CHANGE + 1     # (3,) a rate that waits for the next to resemble it
HELD_STEP = HELD_RATE + 3  # s, the step that it ended
SLOPE = HELD_STEP + 1      # (3,) rad/s^2, the last that each axis showed within its limit
X_SIZE = SLOPE + 3

# Integer state.
BLOCK_MAGS = st.K_COMMON
REST_SINCE = BLOCK_MAGS + 1
CLIPPED = BLOCK_MAGS + 2   # bit per axis at its limit
WAS_CLIPPED = BLOCK_MAGS + 3  # the same in the block before
REPEATS = BLOCK_MAGS + 4   # (3,) how often each axis repeated its largest value
WORLD_TURNED = REPEATS + 3  # the heading was fixed in this block
BLOCK_START = WORLD_TURNED + 1  # stamp of the last block's end
HELD = BLOCK_START + 1     # 1: a rate waits
K_SIZE = HELD + 1

# Parameters.
(P_BLOCK, P_ACC_WALK, P_VEL_SD, P_VEL_TIME, P_POS_SD, P_POS_TIME, P_LOCAL_SD, P_LOCAL_TIME,
 P_FIELD_WALK, P_MAG_RELATIVE, P_NORM_FACTOR, P_REST_RATE, P_REST_FORCE, P_REST_TIME,
 P_REST_RATE_SD, P_SURGE_SD, P_SURGE_TIME, P_ESTIMATE_BIAS, P_SCALE_SD, P_OFFSET_SD, P_SOFT_SD,
 P_LAG_SD, P_FOLLOW_FIELD, P_HEADING_SD, P_USE_ACC) = range(st.P_COMMON, st.P_COMMON + 25)
P_SIZE = st.P_COMMON + 25
