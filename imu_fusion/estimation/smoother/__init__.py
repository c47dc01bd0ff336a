"""Constrained smoothing of whole recordings (Fang et al. 2020, and beyond)."""

from imu_fusion.estimation.smoother.params import SmootherParams  # noqa: F401
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult  # noqa: F401
from imu_fusion.estimation.smoother.smoother import Smoother  # noqa: F401
