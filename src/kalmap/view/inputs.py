"""What the pictures and pages are made from. Everything is computed elsewhere and handed in."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.se2 import rotate
from kalmap.records import Estimate, OccupancyGrid, Trace, Trajectory, final_course


class Aligned(msgspec.Struct, frozen=True):
    """A reference, already moved into the estimate's frame.

    kind: "truth", "gps", "batch" or "survey". path: (K, 2) m. landmarks: (M, 2) m. point: (2,) m, the point of
    the vehicle (forward, left) that the path is of. walls: (S, 4) m, true contours from x, y to x, y.
    """

    kind: str = "truth"
    point: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(2))
    path: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 2)))
    landmarks: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 2)))
    walls: np.ndarray = msgspec.field(default_factory=lambda: np.zeros((0, 4)))


class Errors(msgspec.Struct, frozen=True):
    """Estimate minus reference at E instants, with what the filter said its errors would be.

    times: (E,) s. values: (E, 3) x m, y m, heading rad; sigmas: (E, 3) standard deviations of them.
    nees: (E,) normalised estimation error squared, of `nees_dof` degrees of freedom. NaN where unknown.
    """

    times: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray
    nees: np.ndarray
    nees_dof: int = 3

    def __len__(self) -> int:
        return len(self.times)

    def has_heading(self) -> bool:
        """Whether any heading of the reference is known."""
        return bool(np.isfinite(self.values[:, 2]).any())


class SetCurve(msgspec.Struct, frozen=True):
    """One method's map as a set, over F instants, (F,) each.

    number: features in the map. ospa, localisation, cardinality: m, the distance to the true map and its parts.
    """

    method: str
    number: np.ndarray
    ospa: np.ndarray
    localisation: np.ndarray
    cardinality: np.ndarray


class SetView(msgspec.Struct, frozen=True):
    """The map of a run as a random finite set.

    weights: (N,) expected landmarks of each component of the last map; means: (N, 2) m; covariances: (N, 2, 2) m^2.
    times: (F,) s, number: (F,) landmarks in the map. curve, true_number: (F,) against the truth, None without one.
    cutoff: m, of the OSPA. kind: of the reference, as in `Aligned`.
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    times: np.ndarray
    number: np.ndarray
    curve: SetCurve | None = None
    true_number: np.ndarray | None = None
    cutoff: float | None = None
    kind: str = "truth"


class RunView(msgspec.Struct, frozen=True):
    """One run as the pictures want it: method (its label), log (its name) and what came out.

    reference, errors: None where nothing is known from outside. sets: None where the map is no random finite set.
    grid: what scans swept, None without scans. odometry: (K, 2) m, the path by odometry alone, None where not kept.
    """

    method: str
    log: str
    estimate: Estimate
    trace: Trace
    reference: Aligned | None = None
    errors: Errors | None = None
    sets: SetView | None = None
    grid: OccupancyGrid | None = None
    odometry: np.ndarray | None = None

    @property
    def course(self) -> Trajectory:
        """The drive as it is seen at the end."""
        return final_course(self.estimate, self.trace)

    @property
    def start_time(self) -> float:
        """The clock's zero in every picture, s."""
        return float(self.trace.times[0]) if len(self.trace.times) else float(self.estimate.time)

    def path(self) -> tuple[np.ndarray, str]:
        """The estimated path (F, 2) of the point that the reference speaks of, and what to call it."""
        poses = self.course.poses
        if self.reference is None or not self.reference.point.any():
            return poses[:, :2], "estimated path"
        moved = poses[:, :2] + rotate(poses[:, 2], self.reference.point[None])
        return moved, f"estimated path of the {self.reference.kind} point"

    @property
    def title(self) -> str:
        return f"{self.log}: {self.method}"


class StudyCurve(msgspec.Struct, frozen=True):
    """RMS over the runs of a study: times (F,) s, position (F,) m, heading (F,) rad, for one method."""

    method: str
    times: np.ndarray
    position: np.ndarray
    heading: np.ndarray


class StudyRow(msgspec.Struct, frozen=True):
    """One method's numbers, and beside them the paper's where it gives any (None, or None a cell)."""

    method: str
    ours: tuple[float | None, ...]
    paper: tuple[float | None, ...] | None = None


class StudyTable(msgspec.Struct, frozen=True):
    """A table of a study: columns name quantity and unit, one for each number of a row.

    decimals: of each column, None for as many as a number's size wants; empty means None throughout.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[StudyRow, ...]
    note: str = ""
    decimals: tuple[int | None, ...] = ()


class StudyDots(msgspec.Struct, frozen=True):
    """One method's values (n,) of a metric, one a seed, and the paper's single value where it gives one.

    group: methods of the same group have the same colour.
    """

    method: str
    values: np.ndarray
    group: str = ""
    paper: float | None = None
