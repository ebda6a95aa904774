"""Which sightings and landmarks of a frame have to do with each other, those decided in most doubt first."""

from __future__ import annotations

import msgspec
import numpy as np

from kalmap.geometry.se2 import rotate
from kalmap.records import Frame
from kalmap.records.trail import doubts


class Group(msgspec.Struct, frozen=True):
    """Sightings and landmarks that pairs inside the wide gate connect. doubts: sightings decided in doubt."""

    sightings: tuple[int, ...]
    landmarks: tuple[int, ...]
    doubts: int


def points_of(frame: Frame) -> np.ndarray:
    """(M, 2) m, in the map: where the sightings lie, seen from the sensor's predicted pose."""
    distance, angle = frame.values[:, 0], frame.values[:, 1] + frame.sensor[2]
    return rotate(angle, np.column_stack([distance, np.zeros(len(distance))])) + frame.sensor[:2]


def groups(frame: Frame) -> list[Group]:
    """Every group with at least one pair: most doubts first; of equals more left unused, then the larger d^2 taken."""
    why, labels = frame.why, frame.labels.tolist()
    widest = max(why.gate, why.new_gate)
    near = [
        (m, landmark, squared)
        for (m, landmark), squared in zip(why.pairs.tolist(), why.squared.tolist())
        if landmark == labels[m] or squared < widest
    ]
    leader = {m: m for m, _, _ in near}  # of the sightings of one group, the smallest

    def lead(m: int) -> int:
        while leader[m] != m:
            m = leader[m]
        return m

    first: dict[int, int] = {}
    for m, landmark, _ in near:
        one, other = lead(m), lead(first.setdefault(landmark, m))
        leader[max(one, other)] = min(one, other)
    kinds = doubts(frame)
    found = []
    for head in sorted({lead(m) for m in leader}):
        inside = tuple(m for m in leader if lead(m) == head)
        taken = [squared for m, landmark, squared in near if m in inside and landmark == labels[m]]
        touched = tuple(sorted({landmark for m, landmark, _ in near if m in inside}))
        group = Group(tuple(sorted(inside)), touched, sum(bool(kinds[m]) for m in inside))
        unused = sum(labels[m] < 0 for m in inside)
        found.append((-group.doubts, -unused, -max(taken, default=0.0), group.sightings, group))
    return [ranked[-1] for ranked in sorted(found, key=lambda one: one[:-1])]
