"""How far an estimated map is from the true one, both as sets: OSPA, GOSPA, COLA and the number of features.

All rest on the best pairing of the two sets within a cut-off c, the one of least
sum over pairs of d^p + c^p (unpaired features of the smaller set). Sums are kept in units of c^p.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from kalmap.evaluation.pairing import best_pairing
from kalmap.records import KalmapError

# largest |p ln c| at which c^p is a double with room to be multiplied
_LARGEST_POWER = 300.0


class SetError(KalmapError, ValueError):
    """A set of positions, or an order, cut-off or alpha, between which no distance is defined."""


class Ospa(msgspec.Struct, frozen=True):
    """m, all three: value^p = localisation^p + cardinality^p. Between 0 and the cut-off."""

    value: float
    localisation: float
    cardinality: float


class Gospa(msgspec.Struct, frozen=True):
    """value: m. localisation, missed, false: m^p, with value^p = localisation + missed + false.

    paired: pairs less than the cut-off apart, which alone make the localisation part. missed_count: true
    features without a partner. false_count: estimated features without one.
    """

    value: float
    localisation: float
    missed: float
    false: float
    paired: int
    missed_count: int
    false_count: int


class Cola(msgspec.Struct, frozen=True):
    """No unit, all three: value^p = localisation^p + cardinality^p; 1 is worth one feature too many."""

    value: float
    localisation: float
    cardinality: float


class CardinalityError(msgspec.Struct, frozen=True):
    """value: features estimated less true ones; negative where some are missing."""

    value: int
    estimated: int
    true: int


class SetPairing(msgspec.Struct, frozen=True):
    """What every distance between two sets is made of.

    estimated, true: their sizes. paired: K, pairs of the best pairing, each less than `cutoff` (m) apart.
    spread: sum over these of (d / cutoff)^order.
    """

    estimated: int
    true: int
    paired: int
    spread: float
    order: float
    cutoff: float

    def ospa(self) -> Ospa:
        """See the function `ospa`."""
        larger = max(self.estimated, self.true, 1)
        return Ospa(*(self.cutoff * self._root(part / larger) for part in self._parts()))

    def cola(self) -> Cola:
        """See the function `cola`."""
        return Cola(*(self._root(part) for part in self._parts()))

    def gospa(self, alpha: float = 2.0) -> Gospa:
        """See the function `gospa`."""
        if not 0.0 < alpha <= 2.0:
            raise SetError(f"alpha: expected a number above 0 and up to 2, got {alpha}")
        missed, false = self.true - self.paired, self.estimated - self.paired
        both = min(missed, false)
        missed_cost, false_cost = (both / 2.0 + (count - both) / alpha for count in (missed, false))
        unit = self.cutoff**self.order
        return Gospa(
            value=self.cutoff * self._root(self.spread + missed_cost + false_cost),
            localisation=unit * self.spread,
            missed=unit * missed_cost,
            false=unit * false_cost,
            paired=self.paired,
            missed_count=missed,
            false_count=false,
        )

    def _parts(self) -> tuple[float, float, float]:
        """Sums in units of c^p: both together, of the smaller set's features, of the surplus ones."""
        smaller, larger = sorted((self.estimated, self.true))
        localisation = self.spread + (smaller - self.paired)
        return localisation + (larger - smaller), localisation, float(larger - smaller)

    def _root(self, total: float) -> float:
        return float(total ** (1.0 / self.order))


def ospa(estimated: np.ndarray, true: np.ndarray, *, order: float = 2.0, cutoff: float) -> Ospa:
    """Optimal sub-pattern assignment distance (Schuhmacher, Vo and Vo 2008, eq. 3 and 4).

    estimated: (N, 2), true: (M, 2), m. order: p >= 1. cutoff: c > 0, m. With N <= M, else the other way round,

        ((min over assignments of sum_i min(d_i, c)^p + c^p (M - N)) / M)^(1/p),

    of which the first sum is the localisation part (also where its distances are cut off) and the second
    the cardinality part. 0 for two empty sets. Raises `SetError`, as do all distances of this module, for
    another shape, positions that are not finite, or parameters out of their range.
    """
    return pair_sets(estimated, true, order=order, cutoff=cutoff).ospa()


def gospa(
    estimated: np.ndarray, true: np.ndarray, *, order: float = 2.0, cutoff: float, alpha: float = 2.0
) -> Gospa:
    """Generalised OSPA (Rahmathullah, Garcia-Fernandez and Svensson 2017, eq. 1).

    Arguments as for `ospa`; alpha in (0, 2]. With N <= M, else the other way round,

        (min over assignments of sum_i min(d_i, c)^p + c^p / alpha (M - N))^(1/p).

    With alpha 2 each feature without a partner within c costs c^p / 2, whichever set it is of (their
    proposition 1). With another alpha a missed feature and a false one that an assignment joins cost
    c^p / 2 each, and surplus ones c^p / alpha; the parts still sum to value^p.
    """
    return pair_sets(estimated, true, order=order, cutoff=cutoff).gospa(alpha)


def cola(estimated: np.ndarray, true: np.ndarray, *, order: float = 2.0, cutoff: float) -> Cola:
    """Cardinalised optimal linear assignment distance (Barrios, Adams, Leung and others 2017).

    Arguments as for `ospa`, whose sum over features is not divided by their number here but by c^p:

        (min over assignments of sum_i min(d_i, c)^p + c^p (M - N))^(1/p) / c.
    """
    return pair_sets(estimated, true, order=order, cutoff=cutoff).cola()


def cardinality_error(estimated: np.ndarray, true: np.ndarray) -> CardinalityError:
    """How many features too many (positive) or too few: N - M of (N, 2) and (M, 2)."""
    found = len(checked_positions("estimated", estimated))
    there = len(checked_positions("true", true))
    return CardinalityError(found - there, found, there)


def pair_sets(estimated: np.ndarray, true: np.ndarray, *, order: float, cutoff: float) -> SetPairing:
    """The best pairing of (N, 2) with (M, 2), from which all distances of the same order and cut-off follow.

    A full assignment with distances cut off at c is one of the pairs below c, completed by pairs that cost
    c^p whichever they are: so only pairs below c are looked at, and what hangs together is solved by itself.
    """
    if not 1.0 <= order < math.inf:
        raise SetError(f"order: expected a finite number of 1 or more, got {order}")
    if not (0.0 < cutoff < math.inf and order * abs(math.log(cutoff)) <= _LARGEST_POWER):
        raise SetError(f"cutoff: expected a number above 0 whose power {order:g} is finite, got {cutoff}")
    mine, theirs = checked_positions("estimated", estimated), checked_positions("true", true)
    rows, columns, cost = _near(mine, theirs, order, cutoff)
    first, second = best_pairing(rows, columns, cost, 1.0)
    gap = mine[first] - theirs[second]
    spread = float(np.sum((np.hypot(gap[:, 0], gap[:, 1]) / cutoff) ** order))
    return SetPairing(len(mine), len(theirs), len(first), spread, float(order), float(cutoff))


def _near(
    mine: np.ndarray, theirs: np.ndarray, order: float, cutoff: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and (d / c)^p (K,) of the pairs less than the cut-off apart."""
    from scipy.spatial import cKDTree

    if not (len(mine) and len(theirs)):
        none = np.zeros(0, dtype=np.int64)
        return none, none, np.zeros(0)
    near = cKDTree(mine).sparse_distance_matrix(cKDTree(theirs), cutoff, output_type="ndarray")
    cost = (near["v"] / cutoff) ** order
    below = cost < 1.0
    return near["i"][below], near["j"][below], cost[below]


def checked_positions(name: str, values: np.ndarray) -> np.ndarray:
    """(N, 2) finite positions; any empty list is none. Raises `SetError` that begins with `name`."""
    positions = np.asarray(values, dtype=np.float64)
    if positions.size == 0:
        return np.zeros((0, 2))
    if positions.ndim != 2 or positions.shape[1] != 2:
        raise SetError(f"{name}: expected positions of shape (N, 2), got {positions.shape}")
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise SetError(f"{name}: position {bad[0]} is {positions[bad[0]].tolist()}, not finite")
    return positions
