"""Joint compatibility branch and bound as an associator."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.checks import check
from kalmap.association.gated import Gated, Matching, Table
from kalmap.association.joint import JointMatch, jcbb, randomised_joint
from kalmap.geometry.angles import wrap
from kalmap.kernels import nearest as kernel
from kalmap.records import Reason


class Jcbb(Gated, frozen=True, kw_only=True, tag=True):
    """The largest set of pairs that are jointly compatible, and of those the one of least joint distance.

    Neira & Tardos 2001. joint_gate: probability of the joint test. work: nodes of the search at most; when they
    are used up the best set found so far is taken, and a note on the frame says so. randomised_from: frames with
    at least so many sightings inside a gate take the randomised variant (Paz, Tardos & Neira 2008), drawn from
    `seed`. Attributes decide here which pairs are possible, and have no part in the joint distance.
    """

    joint_gate: float = 0.999
    work: int = 20_000
    randomised_from: int = 40
    seed: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0.0 <= self.joint_gate <= 1.0, "joint_gate", "a probability", self.joint_gate)
        check(self.work >= 1, "work", "1 or more", self.work)

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        possible = (table.squared <= table.gate) & ~table.trial
        rows, wanted = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
        if not len(rows):
            return Matching(columns, Reason.JOINT, Reason.JOINTLY_INCOMPATIBLE)
        inside = possible[np.ix_(rows, wanted)]
        if inside.sum() == 1:  # one pair alone has nothing to be compatible with
            columns[rows[0]] = wanted[0]
            return Matching(columns, Reason.JOINT, Reason.JOINTLY_INCOMPATIBLE)
        expected = table.expected.take(wanted)
        nu = table.sightings.values[rows, None] - expected.z[None]
        nu[..., 1] = wrap(nu[..., 1])
        squared = np.where(inside, table.squared[np.ix_(rows, wanted)], np.inf)
        problem = nu, predicted.cross(expected), predicted.noises[rows], squared
        settings: dict[str, Any] = {
            "gate": table.gate,
            "joint_probability": self.joint_gate,
            "work": self.work,
        }
        randomised = len(rows) >= self.randomised_from
        if randomised:
            found = randomised_joint(*problem, **settings, rng=np.random.default_rng(self.seed))
        else:
            found = jcbb(*problem, **settings)
        hit = found.matched >= 0
        columns[rows[hit]] = wanted[found.matched[hit]]
        return Matching(
            columns, Reason.JOINT, Reason.JOINTLY_INCOMPATIBLE, _notes(found, randomised, predicted)
        )


def _notes(found: JointMatch, randomised: bool, predicted: Predicted) -> tuple[str, ...]:
    if not predicted.explain:
        return ()
    text = f"{found.pairs} pairs, joint distance {found.squared:.2f} squared, {found.nodes} nodes"
    if randomised:
        return (f"{text}; randomised, the best of several tries",)
    return (text if found.complete else f"{text}; work limit hit, best so far taken",)
