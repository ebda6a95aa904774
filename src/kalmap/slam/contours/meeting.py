"""Where two finished contour maps lie to each other, nothing known beforehand: one place, or an honest refusal."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import inverse, rotate
from kalmap.kernels import correlate
from kalmap.slam.contours.belief import is_elsewhere
from kalmap.slam.contours.closed import CELL, ClosedMap, Shape
from kalmap.slam.contours.join import joined
from kalmap.slam.contours.matching import Overlay, overlay
from kalmap.slam.submaps.matching import NoMatchError

POINTS = 500  # of the second map's contours that are tried everywhere, at most
TRIED = 60  # places of the search that are looked at closely
LEAST_SHARE = 0.06  # of the second map's points that must fit somewhere for it to be a place
APART, BENT, APART_TURN = (
    0.5,
    2.0,
    0.15,
)  # m, m where maps bend, and rad, between places that are not the same
MATCHED = 12.0  # m of contour that must lie on each other
AGREEMENT = 0.85  # share of what lies side by side that must lie on each other
LOOSE_AGREEMENT = 0.5  # the same before either map may bend
VAGUE = (0.5**2, 0.5**2, 0.1**2)  # m^2, m^2, rad^2: what is known of a place before the maps are fitted
UNIQUE = 0.8  # the next best place must be below this share of the best
MOST_PLACES = 4  # that are tried in full
HELD = 0.25  # m, standard deviation of the place in its loosest direction: a corridor alone does not hold it
STRIP = 0.9  # m in front of a contour that was seen: nothing else stands there
CLEAR = 0.15  # m: what is nearer to a contour belongs to it
THROUGH, THROUGH_SHARE = (
    1.5,
    0.04,
)  # m, and share of the matched length, that may stand where the other map saw nothing


class Place(msgspec.Struct, frozen=True, eq=False):
    """A place of the second map on the first, and m of contour of either that stands in the other's free space."""

    overlay: Overlay
    through: float

    @property
    def worth(self) -> float:
        """m of contour that speak for the place."""
        return self.overlay.matched * self.overlay.agreement - 2.0 * self.through


class Met(msgspec.Struct, frozen=True, eq=False):
    """How two maps lie. pose: (3,) T_first_second; covariance: (3, 3). map: both in one, in the first's frame, its pose
    the second's; None where a map has no joint covariance. matched: m of contour that lie on each other; agreement;
    through: as in `Place`."""

    pose: np.ndarray
    covariance: np.ndarray
    map: ClosedMap | None
    matched: float
    agreement: float
    through: float


def meet(first: ClosedMap, second: ClosedMap, joint: bool = True) -> Met:
    """The one place where the second map lies on the first, and the two in one.

    joint: whether both have their joint covariances; then a map may bend to fit the other, as drives bend their maps.
    Raises NoMatchError, with the reason, if there is no place that is long, clear and unique enough to be sure.
    """
    places = find_places(first, second, *((LOOSE_AGREEMENT, BENT) if joint else (AGREEMENT, APART)))
    found: list[Met] = []
    problem: NoMatchError | None = None
    for place in places:
        try:
            found.append(_joined_at(first, second, place) if joint else _laid_at(place))
        except NoMatchError as refusal:
            problem = problem or refusal
    if not found:
        raise problem or NoMatchError("the maps do not seem to overlap")
    found.sort(key=lambda met: -met.matched * met.agreement)
    best = found[0]
    if len(found) > 1 and found[1].matched * found[1].agreement > UNIQUE * best.matched * best.agreement:
        raise NoMatchError(
            f"the maps fit in more than one way: {best.matched:.1f} m of contour at the best place, "
            f"{found[1].matched:.1f} m at another"
        )
    return best


def _laid_at(place: Place) -> Met:
    """The second map moved as a whole. Raises NoMatchError where that is not believed."""
    laid = place.overlay
    _believe(laid.agreement, place.through, laid.matched, laid.covariance)
    return Met(laid.pose, laid.covariance, None, laid.matched, laid.agreement, place.through)


def _joined_at(first: ClosedMap, second: ClosedMap, place: Place) -> Met:
    """Both maps bent to fit each other. Raises NoMatchError where they do not, or that is not believed."""
    result = joined(_ending_at(first, place.overlay.pose), second)
    if result.map is None or result.agreement is None:
        reason = result.why or "nothing is shared"
        raise NoMatchError(f"the best place of the maps on each other is not believed: {reason}")
    a, b = result.laid
    through = _through(a.shape, b.shape, result.pose) + _through(b.shape, a.shape, inverse(result.pose))
    final = overlay(a, b, result.pose)
    matched = 0.0 if final is None else final.matched
    _believe(result.agreement, through, matched, result.pose_covariance)
    return Met(result.pose, result.pose_covariance, result.map, matched, result.agreement, through)


def _ending_at(first: ClosedMap, pose: np.ndarray) -> ClosedMap:
    """The map as if its drive had ended where the other one begins, about."""
    covariance = first.covariance.copy()
    covariance[:3], covariance[:, :3] = 0.0, 0.0
    covariance[:3, :3] = np.diag(VAGUE)
    return msgspec.structs.replace(first, mean=np.concatenate([pose, first.mean[3:]]), covariance=covariance)


def find_places(first: ClosedMap, second: ClosedMap, agreement: float, apart: float) -> list[Place]:
    """The best of all places, and those `apart` m and more away that are nearly as good. Raises NoMatchError."""
    for each, which in ((first, "first"), (second, "second")):
        if not len(each.shape.points):
            raise NoMatchError(
                f"the {which} map holds no contour that is seen twice and longer than a sample"
            )
    places = [_placed(first, second, pose) for pose in everywhere(first.shape, second.shape)]
    good = [place for place in places if place is not None and place.overlay.agreement >= agreement]
    found = sorted(good, key=lambda place: -place.worth)
    if not found or found[0].overlay.matched < MATCHED:
        most = found[0].overlay.matched if found else 0.0
        raise NoMatchError(
            f"the maps do not seem to overlap: at best {most:.1f} m of contour lie on each other, "
            f"{MATCHED:g} m are needed"
        )
    kept: list[Place] = []
    for place in found:
        other = all(is_elsewhere(each.overlay.pose, place.overlay.pose, apart, APART_TURN) for each in kept)
        if other and place.worth > UNIQUE * found[0].worth:
            kept.append(place)
    if len(kept) > MOST_PLACES:
        raise NoMatchError(f"the maps fit in more than one way: {len(kept)} places are as good as each other")
    return kept


def _believe(agreement: float, through: float, matched: float, covariance: np.ndarray) -> None:
    """Raise NoMatchError, with the reason, unless a place is good enough."""
    loosest = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    problem = None
    if matched < MATCHED:
        problem = f"only {matched:.1f} m of contour lie on each other, {MATCHED:g} m are needed"
    elif agreement < AGREEMENT:
        problem = f"only {agreement:.0%} of what lies side by side agrees"
    elif through > max(THROUGH, THROUGH_SHARE * matched):
        problem = f"{through:.1f} m of contour stand where the other map has nothing"
    elif loosest > HELD:
        problem = f"along the contours it is unsure by {loosest:.2f} m"
    if problem is not None:
        raise NoMatchError(f"the best place of the maps on each other is not believed: {problem}")


def everywhere(a: Shape, b: Shape) -> list[np.ndarray]:
    """Poses (3,) of b on a, the best first, from a search over all places and turns at which they may touch."""
    step = max(1, math.ceil(len(b.points) / POINTS))
    points = np.ascontiguousarray(b.points[::step] - b.centre)
    normals = np.ascontiguousarray(b.point_normals[::step])
    turn = min(0.03, 2.5 * CELL / max(1.0, b.radius))
    angles = np.arange(-math.pi, math.pi, turn)
    half = a.radius + b.radius
    values, places = np.zeros(TRIED), np.zeros((TRIED, 3), dtype=np.int64)
    count = correlate.search_places(
        a.levels, a.low, CELL, points, normals, a.centre, angles, math.ceil(half / CELL), LEAST_SHARE,
        APART / CELL, values, places,
    )  # fmt: skip
    found = []
    for angle, row, column in places[:count]:
        at = a.centre + CELL * np.array([column, row]) - rotate(angles[angle], b.centre)
        found.append(np.array([at[0], at[1], float(wrap(angles[angle]))]))
    return found


def _placed(first: ClosedMap, second: ClosedMap, pose: np.ndarray) -> Place | None:
    laid = overlay(first, second, pose)
    if laid is None or not np.isfinite(laid.pose).all():
        return None
    through = _through(first.shape, second.shape, laid.pose)
    return Place(laid, through + _through(second.shape, first.shape, inverse(laid.pose)))


def _through(a: Shape, b: Shape, T_a_b: np.ndarray) -> float:
    """m of b's contours that stand before one of a's, within `STRIP`, where a has none."""
    points = T_a_b[:2] + rotate(T_a_b[2], b.points)
    way = a.segments[:, 2:] - a.segments[:, :2]
    length = np.maximum(1e-9, np.hypot(*way.T))
    tree = cKDTree(a.segments[:, :2] + 0.5 * way)
    near = min(12, len(length))
    away, which = tree.query(points, k=near, distance_upper_bound=STRIP + 0.5)
    away, which = away.reshape(len(points), near), which.reshape(len(points), near)
    known = np.isfinite(away)
    which = np.where(known, which, 0)
    arm = points[:, None] - a.segments[which, :2]
    t = (arm * way[which]).sum(axis=2) / length[which] ** 2
    off = (arm * a.normals[which]).sum(axis=2)
    beside = known & (t >= 0.0) & (t <= 1.0)
    before = beside & (off > CLEAR) & (off < STRIP)
    reach = np.hypot(off, np.maximum(0.0, np.maximum(-t, t - 1.0)) * length[which])
    close = (known & (reach < CLEAR + 0.15)).any(axis=1)
    return float(0.1 * (before.any(axis=1) & ~close).sum())
