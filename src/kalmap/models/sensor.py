"""Sensor models: what a landmark looks like from the vehicle."""

from __future__ import annotations

from typing import ClassVar, Protocol

import msgspec
import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.geometry.ellipses import chi_square_2
from kalmap.geometry.se2 import rotate
from kalmap.kernels import layout
from kalmap.records import SensorConfig


class SensorModel(Protocol):
    """What the filter asks of a sensor for point landmarks."""

    @property
    def compiled(self) -> bool:
        """Whether the kernels know it; False for any sensor but the built-in one."""
        ...

    def predict(self, pose: np.ndarray, landmark: np.ndarray) -> np.ndarray:
        """(..., 3) and (..., 2) -> (..., 2) range m and bearing rad."""
        ...

    def locate(self, pose: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The inverse: (..., 3) and (..., 2) -> (..., 2) landmark."""
        ...

    def covariance(self, z: np.ndarray) -> np.ndarray:
        """(M, 2) -> (M, 2, 2) noise of each sighting."""
        ...


class RangeBearing(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    """Range and bearing from a sensor mounted at (x m, y m, heading rad) on the vehicle.

    sigma_range m, ratio_range of the range, sigma_bearing rad; min_range, max_range m; field_of_view rad, the full
    angle.
    outlier_gate: probability beyond which a sighting's noise is inflated (see `SensorConfig`), None: never.
    """

    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma_range: float = 0.1
    ratio_range: float = 0.0
    sigma_bearing: float = float(np.deg2rad(1.0))
    min_range: float = 0.0
    max_range: float = 30.0
    field_of_view: float = float(np.pi)
    outlier_gate: float | None = None
    compiled: ClassVar[bool] = True

    def predict(self, pose: np.ndarray, landmark: np.ndarray) -> np.ndarray:
        """(..., 3) and (..., 2) -> (..., 2)."""
        body = rotate(-pose[..., 2], landmark - pose[..., :2]) - np.array(self.mount[:2])
        bearing = wrap(np.arctan2(body[..., 1], body[..., 0]) - self.mount[2])
        return np.stack([np.hypot(body[..., 0], body[..., 1]), bearing], axis=-1)

    def locate(self, pose: np.ndarray, z: np.ndarray) -> np.ndarray:
        """(..., 3) and (..., 2) -> (..., 2)."""
        angle = z[..., 1] + self.mount[2]
        body = np.stack([z[..., 0] * np.cos(angle), z[..., 0] * np.sin(angle)], axis=-1) + np.array(
            self.mount[:2]
        )
        return pose[..., :2] + rotate(pose[..., 2], body)

    def covariance(self, z: np.ndarray) -> np.ndarray:
        """(M, 2) -> (M, 2, 2)."""
        noise = np.zeros((len(z), 2, 2))
        noise[:, 0, 0] = self.sigma_range**2 + (self.ratio_range * z[:, 0]) ** 2
        noise[:, 1, 1] = self.sigma_bearing**2
        return noise

    def fill(self, setup: np.ndarray) -> None:
        """Write the sensor's part of the kernels' setup vector."""
        setup[layout.MOUNT_X], setup[layout.MOUNT_Y], setup[layout.MOUNT_HEADING] = self.mount
        setup[layout.SIGMA_RANGE], setup[layout.RATIO_RANGE] = self.sigma_range, self.ratio_range
        setup[layout.SIGMA_BEARING] = self.sigma_bearing
        setup[layout.OUTLIER_GATE] = outlier_distance(self)


def outlier_distance(sensor: object) -> float:
    """The Mahalanobis distance squared of a sensor's outlier gate (two degrees of freedom); 0 if it has none."""
    probability = getattr(sensor, "outlier_gate", None)
    return 0.0 if probability is None else chi_square_2(probability)


def sensor_from_config(config: SensorConfig) -> RangeBearing:
    """The sensor that a configuration describes."""
    return RangeBearing(
        mount=(config.mount_x, config.mount_y, float(np.deg2rad(config.mount_heading_deg))),
        sigma_range=config.sigma_range,
        ratio_range=config.sigma_range_ratio,
        sigma_bearing=float(np.deg2rad(config.sigma_bearing_deg)),
        min_range=config.min_range,
        max_range=config.max_range,
        field_of_view=float(np.deg2rad(config.field_of_view_deg)),
        outlier_gate=config.outlier_gate,
    )
