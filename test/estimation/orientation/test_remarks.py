"""What is said of estimates that are doubtful."""

import numpy as np
import pytest

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.remarks import remarks
from imu_fusion.estimation.orientation.state import new_state


@pytest.mark.parametrize(("scale", "sd", "said"), [
    ((-0.08, 0.002, 0.0), 0.005, "8, 0, 0 %"), ((0.0, 0.09, 0.0), 0.009, "0, -9, 0 %"),
    ((-0.08, 0.0, 0.0), 0.015, None), ((0.03, 0.0, 0.0), 0.001, None)])
def test_a_scale_is_said_where_it_is_surely_far_off(scale, sd, said):
    """Of a gyroscope that shows 8 % too much, and not of one of which little is known."""
    state, par = new_state()[0], kernel_parameters(OrientationParams())
    state["gyro_scale"][:] = np.diag(scale)
    for i in range(es.GYRO_SCALE, es.VELOCITY):
        state["cov"][i, i] = sd ** 2
    for hypothesis in par[:2]:    # as stated, and poor: what is far off is the same
        found = remarks(state, hypothesis, 0)
        assert len(found) == (said is not None)
        assert said is None or said in found[0]


@pytest.mark.parametrize(("bias", "sd", "lasting", "said"), [
    (0.4, 0.02, 0, True), (-0.4, 0.02, 0, True), (0.4, 0.08, 0, False), (0.2, 0.001, 0, False),
    (0.4, 0.02, 1, False)])
def test_a_force_is_said_to_be_off_where_it_surely_is(bias, sd, lasting, said):
    """And not where the bias stands for accelerations that last."""
    state, par = new_state()[0], kernel_parameters(OrientationParams())
    state["acc_bias"][1] = bias
    for i in range(es.ACC_BIAS, es.MAG_LAG):
        state["cov"][i, i] = sd ** 2
    hypothesis = par[(par["lasting_acc_sd"] > 0.0) == bool(lasting)][0]
    found = remarks(state, hypothesis, 0)
    assert len(found) == said and all(f"0.00, {bias:.2f}, 0.00" in text for text in found)
