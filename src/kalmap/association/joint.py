"""The largest jointly compatible set of pairs: exactly, by branch and bound, and from random beginnings."""

from __future__ import annotations

import functools

import msgspec
import numpy as np

from kalmap.gaussian import NotPositiveError
from kalmap.geometry.ellipses import chi_square
from kalmap.kernels.joint import extend_jointly, joint_compatibility
from kalmap.kernels.layout import OK
from kalmap.records import ConfigError, KalmapError

WORK = 20_000

Problem = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # nu, cross, noises, squared


class JointMatch(msgspec.Struct, frozen=True):
    """A one-to-one set of pairs.

    matched: (M,) int64, the candidate of each sighting or -1. pairs: how many. squared: their joint distance
    squared. nodes: sets that the search looked beyond. complete: nothing was left out, so that no jointly
    compatible set has more pairs, and none as many at a lower distance; else it is the best that was found.
    """

    matched: np.ndarray
    pairs: int
    squared: float
    nodes: int
    complete: bool


def jcbb(
    nu: np.ndarray,
    cross: np.ndarray,
    noises: np.ndarray,
    squared: np.ndarray,
    *,
    gate: float,
    joint_probability: float,
    work: int = WORK,
) -> JointMatch:
    """Joint compatibility branch and bound (Neira & Tardos 2001): most pairs first, then least joint distance.

    nu: (M, C, 2) innovation of each sighting with each candidate, m and rad, the bearing wrapped; NaN where a pair is
    impossible. cross: (C, C, 2, 2) covariance of the candidates' predicted sightings with each other, the sensor's
    noise left out. noises: (M, 2, 2) that noise, independent between sightings. squared: (M, C) individual
    Mahalanobis distances squared. gate: their bound; 0 lets nothing in. joint_probability: of the chi-square test
    of the joint distance squared, 2 k degrees of freedom for k pairs. work: nodes of the search at most; where it
    ends early the answer is the best set found, never worse than that of sequential compatibility (the sightings
    with the fewest candidates first, each with the free candidate that adds least, given the pairs before it).

    Raises NotPositiveError if the search meets an innovation covariance that is not positive definite, ConfigError
    for a gate, probability or bound on work that is none, KalmapError for arrays whose shapes disagree.
    """
    problem = _checked(nu, cross, noises, squared, gate, work)
    return _branch_and_bound(problem, gate, _joint_gate(joint_probability, len(squared)), work)


def randomised_joint(
    nu: np.ndarray,
    cross: np.ndarray,
    noises: np.ndarray,
    squared: np.ndarray,
    *,
    gate: float,
    joint_probability: float,
    rng: np.random.Generator,
    work: int = WORK,
    drawn: int = 4,
    tries: int = 9,
) -> JointMatch:
    """Randomised joint compatibility (Paz, Tardos & Neira 2008), for frames with many sightings.

    Each try draws `drawn` sightings that have candidates, matches them by branch and bound, and adds the others one
    by one, always the pair that is nearest given those before it, while the set stays inside its joint gate; the
    best of the tries counts. 9 tries of 4 hit upon four good sightings with 99 % if 80 % of them are good:
    ln 0.01 / ln(1 - 0.8^4). `work` bounds the nodes of all tries together. Where no more sightings than `drawn` have
    candidates this is `jcbb`; else `complete` is False. The rest as for `jcbb`.
    """
    problem = _checked(nu, cross, noises, squared, gate, work)
    nu, cross, noises, squared = problem
    joint_gate = _joint_gate(joint_probability, len(squared))
    if drawn < 1 or tries < 1:
        raise ConfigError(f"drawn, tries: at least 1 is needed, not {drawn} and {tries}")
    rows = np.flatnonzero((squared <= gate).any(axis=1))
    if len(rows) <= drawn:
        return _branch_and_bound(problem, gate, joint_gate, work)
    best, nodes = JointMatch(np.full(len(squared), -1, dtype=np.int64), 0, 0.0, 0, False), 0
    for _ in range(tries):
        some = rng.choice(rows, drawn, replace=False)
        begun = _branch_and_bound(
            (nu[some], cross, noises[some], squared[some]), gate, joint_gate[: drawn + 1], work - nodes
        )
        nodes += begun.nodes
        matched = np.full(len(squared), -1, dtype=np.int64)
        matched[some] = begun.matched
        status, pairs, distance = extend_jointly(*problem, float(gate), joint_gate, matched)
        _require(status)
        if (-pairs, distance) < (-best.pairs, best.squared):
            best = JointMatch(matched, pairs, distance, 0, False)
        if nodes >= work:
            break
    return msgspec.structs.replace(best, nodes=nodes)


def _branch_and_bound(problem: Problem, gate: float, joint_gate: np.ndarray, work: int) -> JointMatch:
    matched = np.empty(len(problem[0]), dtype=np.int64)
    status, pairs, distance, nodes, complete = joint_compatibility(
        *problem, float(gate), joint_gate, int(work), matched
    )
    _require(status)
    return JointMatch(matched, pairs, distance, nodes, complete)


def _require(status: int) -> None:
    if status != OK:
        raise NotPositiveError("the joint innovation covariance of some pairs is not positive definite")


@functools.lru_cache(maxsize=512)
def _joint_gate(probability: float, sightings: int) -> np.ndarray:
    """(M + 1,): the chi-square quantiles of 0, 2, .. 2 M degrees of freedom; that of none is 0."""
    if not 0.0 <= probability <= 1.0:
        raise ConfigError(f"joint_probability: {probability} is no probability")
    return np.array([0.0] + [chi_square(probability, 2 * k) for k in range(1, sightings + 1)])


def _checked(
    nu: np.ndarray, cross: np.ndarray, noises: np.ndarray, squared: np.ndarray, gate: float, work: int
) -> Problem:
    """The four arrays as the kernel takes them: float64, contiguous, writable."""
    if not gate >= 0.0:
        raise ConfigError(f"gate: a distance squared is needed, not {gate}")
    if work < 0:
        raise ConfigError(f"work: a number of nodes is needed, not {work}")
    if squared.ndim != 2:
        raise KalmapError(f"squared: shape (M, C) is needed, not {squared.shape}")
    m, c = squared.shape
    shapes = {"nu": (nu, (m, c, 2)), "cross": (cross, (c, c, 2, 2)), "noises": (noises, (m, 2, 2))}
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise KalmapError(
                f"{name}: shape {shape} is needed beside squared {squared.shape}, not {array.shape}"
            )
    nu, cross, noises, squared = (np.require(a, np.float64, ("C", "W")) for a in (nu, cross, noises, squared))
    return nu, cross, noises, squared
