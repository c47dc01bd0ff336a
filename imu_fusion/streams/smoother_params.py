"""Parameters of the smoother between its topics: its own, and what surrounds it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.smoother import SmootherParams
from imu_fusion.estimation.smoother.params import SurfaceContact
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.sensors.linear_calibration import IDENTITY, ZERO, SensorCalibration


@dataclass(frozen=True)
class SurfaceFile(SurfaceContact):
    """Which surface, and how the body is held on it."""

    file: str | None = param(
        None, path=True, doc="Surface that the body moves on: a name in config/surfaces or the "
        "path of a YAML file; unset: none.")


@dataclass(frozen=True)
class Frames(Parameters):
    """``frame.*``: names in what is published; nothing is transformed by them."""

    world: str = param("world", doc="East-north-up frame of the trajectory. Name it map, as REP "
                       "105 has it, where a robot's frames hang below it.")
    body: str | None = param(None, doc="Frame of the Imu; unset: the frame_id of its messages. "
                             "Name it as your robot does where its driver does not.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, frame in (("world", self.world), ("body", self.body)):
            if frame is not None and (not frame or frame.startswith("/")):
                raise ParameterError(f"parameter 'frame.{name}': '{frame}' is no frame of tf2; "
                                     "give a name without a leading slash")
        if self.world == self.body:
            raise ParameterError(f"parameter 'frame.body': '{self.body}' is the name of "
                                 "frame.world, too; give them two names")


@dataclass(frozen=True)
class SmoothingParams(SmootherParams):
    """The smoother's parameters and what surrounds it."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {**SmootherParams.OLD_NAMES,
                                              "surface": "surface.file"}

    recover_rates: bool = param(
        False, doc="First recover rates beyond the gyroscope's range from the magnetometer, as the "
        "orientation estimator does on a whole recording, and take them with their covariance. "
        "Set it for a body that tumbles beyond the range.")
    calibration: SensorCalibration = SensorCalibration()
    surface: SurfaceFile = SurfaceFile()
    frame: Frames = Frames()
    path_rate: float = param(10.0, unit="Hz", low=0.01, high=1000.0,
                             doc="Rate of smoother/pose and of the poses of smoother/path. Lower "
                                 "it for long recordings.")
    publish_tf: bool = param(
        False, doc="Also write the trajectory to /tf, from frame.world to the frame of the Imu. "
        "Not where another node publishes a parent of that frame. The node needs tf2_msgs.")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.calibration.of_magnetometer(self.sensor)    # two calibrations are refused

    def with_calibrated_magnetometer(self) -> Self:
        """With ``calibration.mag_*`` as the smoother itself takes them."""
        found = self.calibration.of_magnetometer(self.sensor)
        return self.replace(**{**found, "calibration.mag_matrix": IDENTITY,
                               "calibration.mag_bias": ZERO})

    def idle(self) -> dict[str, str]:
        idle = super().idle()
        if self.surface.file is None:
            idle |= dict.fromkeys(("surface.", "jump."), "without surface.file")
        return idle


@dataclass(frozen=True)
class SmootherNodeParams(Parameters):
    """What concerns the node, not the trajectory."""

    smooth_at_end: bool = param(
        False, doc="Smooth when a replay has ended, as if smoother/smooth were called. A refusal, "
        "and a replay that plays not enough or breaks off, end the node with code 1.")
    memory_limit: float = param(1000.0, unit="MB", low=1.0, high=100000.0,
                                doc="Collected samples may take this much; then no more are "
                                    "taken, and smoothing is refused until smoother/clear. Imu "
                                    "and magnetometer at 100 Hz take 32 MB an hour; smoothing "
                                    "takes more (docs/smoother.md).")
