"""A laser scan as pieces of contour: implicit polynomial curves with their uncertainty, and how each ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

import msgspec
import numpy as np

from kalmap.geometry.curves import Curve
from kalmap.records import ConfigError, EventError, Scan, SensorConfig


class EndKind(IntEnum):
    """How a piece ends.

    END: the contour stops; the next beam goes past it. CORNER: another piece begins there. HIDDEN: something nearer
    stands before what follows. VIEW: the last beam. SILENT: the next beam brought no range back. ONWARD: the contour
    goes on, in points of which no piece was made.
    """

    END = 0
    CORNER = 1
    HIDDEN = 2
    VIEW = 3
    SILENT = 4
    ONWARD = 5


class CutConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where a contour is cut, and what its pieces must be.

    sigma_beam_deg: uncertainty of a beam's direction, its width included; it is what makes a wall at a steep angle
        uncertain, where range noise hardly shows.
    grazing_deg: least angle between a beam and a wall up to which neighbouring beams may lie on one contour (Borges &
        Aldon 2004); steepest_deg: the same where two points on either side lie on one line.
    split_cost: chi-square that cutting a run in two must save.
    roughness: m, standard deviation of real walls about a smooth curve, and the least that a piece's sigma is.
    min_points, min_length: a piece of fewer points, or shorter (m), is dropped.
    max_order: of the polynomials; 1: straight lines, else every line bends as its points say.
    sigma_bend: 1/m, of the curvature of a wall on which no bend shows, and 1/m^2 of its change along the wall. Large,
        it leaves straight walls' normals to the noise, which looks like progress along them; small, a bend is missed.
    parameter_cost: chi-square that every number of a curve counts for where one curve may stand for several lines;
        less in proportion where the points' noise is less than the sensor's sigmas say.
    """

    sigma_beam_deg: float = 0.1
    grazing_deg: float = 12.0
    steepest_deg: float = 4.0
    split_cost: float = 25.0
    roughness: float = 0.005
    min_points: int = 4
    min_length: float = 0.05
    max_order: int = 3
    sigma_bend: float = 0.1
    parameter_cost: float = 1.0

    def __post_init__(self) -> None:
        for name in ("grazing_deg", "steepest_deg", "split_cost", "sigma_bend"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"contours: {name} must be finite and positive, got {getattr(self, name)}")
        for name in ("sigma_beam_deg", "roughness", "min_length", "parameter_cost"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConfigError(
                    f"contours: {name} must be finite and not negative, got {getattr(self, name)}"
                )
        if self.min_points < 3:
            raise ConfigError(f"contours: min_points must be 3 or more, got {self.min_points}")
        if self.max_order not in (1, 2, 3):
            raise ConfigError(f"contours: max_order must be 1, 2 or 3, got {self.max_order}")


class Pieces(msgspec.Struct, frozen=True, eq=False):
    """K pieces of contour in the robot's frame, in the order of the beams, anticlockwise.

    coef: (K, 10), cov: (K, 10, 10), origin: (K, 2), scale: (K,), order: (K,) int64, as in `kalmap.geometry.curves`;
        p grows towards the sensor. A piece of order 1 is a line where no bend shows; its higher coefficients and
        their covariance are the little bend that the noise may hide (`kernels.contour_fit.fit_bent_line`).
    sigma: (K,) m, the contour's own roughness about the curve, to be added to every distance by itself.
    first, last: (K,) int64, indices into the scan's beams.
    ends: (K, 2, 2) m, on the curve, first and last. kinds: (K, 2) int64, see `EndKind`.
    lengths: (K,) m along the curve.
    points: (N, 2) m, every beam that brought a range back, in the order of the beams; piece: (N,) int64, -1 where
        none; beam: (N,) int64, its index in the scan.
    """

    coef: np.ndarray
    cov: np.ndarray
    origin: np.ndarray
    scale: np.ndarray
    order: np.ndarray
    sigma: np.ndarray
    first: np.ndarray
    last: np.ndarray
    ends: np.ndarray
    kinds: np.ndarray
    lengths: np.ndarray
    points: np.ndarray
    piece: np.ndarray
    beam: np.ndarray

    def __len__(self) -> int:
        return len(self.coef)

    def curve(self, k: int) -> Curve:
        """Piece k as a curve."""
        return Curve(self.coef[k], self.origin[k], float(self.scale[k]), int(self.order[k]), self.cov[k])


def cut_settings(sensor: SensorConfig, config: CutConfig) -> np.ndarray:
    """What `kalmap.kernels.contour_pieces.cut_and_fit` reads, in the order of `kalmap.kernels.contour_layout`."""
    return np.array(
        [
            sensor.mount_x,
            sensor.mount_y,
            math.radians(sensor.mount_heading_deg),
            sensor.sigma_range,
            sensor.sigma_range_ratio,
            math.radians(config.sigma_beam_deg),
            sensor.min_range,
            sensor.max_range,
            math.radians(config.grazing_deg),
            math.radians(config.steepest_deg),
            config.split_cost,
            config.roughness,
            config.min_points,
            config.min_length,
            config.max_order,
            config.sigma_bend,
            config.parameter_cost,
        ],
        dtype=np.float64,
    )


def cut_scan(scan: Scan, sensor: SensorConfig, config: CutConfig | None = None) -> Pieces:
    """The pieces of contour in a scan.

    Beams may come in any order and go round the full circle; those whose range is not finite, not positive or
    outside the sensor's, or whose bearing is not finite, and all but one of the same bearing, are passed over.
    Ranges are noisy by `sensor.sigma_range` and `sigma_range_ratio`; the sensor's `sigma_bearing_deg`, which is that
    of sighted landmarks, is not used.

    Raises `EventError` if ranges and bearings are not as many.
    """
    from kalmap.kernels.contour_pieces import cut_and_fit  # compiled code is loaded by the first scan

    ranges = np.ascontiguousarray(scan.ranges, dtype=np.float64)
    bearings = np.ascontiguousarray(scan.bearings, dtype=np.float64)
    if ranges.ndim != 1 or ranges.shape != bearings.shape:
        problem = f"{ranges.shape} ranges and {bearings.shape} bearings: expected a row of each, as long"
        raise EventError(problem, time=scan.time, field="ranges")
    return Pieces(*cut_and_fit(ranges, bearings, cut_settings(sensor, config or CutConfig())))


def share_on_contours(scans: Sequence[Scan], sensor: SensorConfig, most: int = 300) -> float | None:
    """Share of the ranges that lie on a piece, in so many scans spread over all of them; None without ranges."""
    chosen = np.unique(np.linspace(0, len(scans) - 1, min(most, len(scans))).round().astype(int))
    pieces = [cut_scan(scans[k], sensor).piece for k in chosen.tolist()]
    on = np.concatenate([np.zeros(0, dtype=np.int64), *pieces]) >= 0
    return float(on.mean()) if len(on) else None
