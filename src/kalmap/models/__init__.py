"""Motion and sensor models, and the models as functions of an error."""

from kalmap.models.motion import Ackermann, Bias, Increments, MotionModel, Unicycle, VelocitySteering
from kalmap.models.sensor import RangeBearing, SensorModel

__all__ = [
    "Ackermann",
    "Bias",
    "Increments",
    "MotionModel",
    "RangeBearing",
    "SensorModel",
    "Unicycle",
    "VelocitySteering",
]
