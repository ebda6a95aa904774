"""Made-up audit trails: frames decided by a plain nearest neighbour over a map whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
import pytest

from kalmap.data import open_audit, write_audit
from kalmap.data.audit import AUDIT
from kalmap.geometry.angles import wrap
from kalmap.records import SPURIOUS, Frame, Managed, Reason, Why

GATE, NEW_GATE = 9.21, 25.0
NOISE = np.diag([0.1**2, np.deg2rad(1.0) ** 2])
Map = Mapping[int, tuple[np.ndarray, np.ndarray]]
"""Landmark number -> its position (2,) m, and the covariance (2, 2) of where it is expected."""


def polar(sensor: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(M, 2) points in the map as range and bearing from a sensor's pose."""
    apart = np.asarray(points, dtype=float).reshape(-1, 2) - sensor[:2]
    return np.column_stack([np.hypot(*apart.T), wrap(np.arctan2(apart[:, 1], apart[:, 0]) - sensor[2])])


def distance(
    sensor: np.ndarray, value: np.ndarray, place: np.ndarray, spread: np.ndarray
) -> tuple[float, float]:
    """d^2 and ln det S of a sighting with a landmark, by the textbook."""
    (expected,) = polar(sensor, place)
    angle = expected[1] + sensor[2]
    cos, sin = np.cos(angle), np.sin(angle)
    jacobian = np.array([[cos, sin], [-sin / expected[0], cos / expected[0]]])
    s = jacobian @ spread @ jacobian.T + NOISE
    nu = value - expected
    nu[1] = wrap(nu[1])
    return float(nu @ np.linalg.solve(s, nu)), float(np.log(np.linalg.det(s)))


def decide(
    number: int,
    known: Map,
    points: np.ndarray,
    *,
    sensor: tuple[float, float, float] = (0.0, 0.0, 0.0),
    time: float | None = None,
    fresh: int = 100,
    trial: tuple[int, ...] = (),
    notes: tuple[str, ...] = (),
    managed: tuple[Managed, ...] = (),
    wide: float = 60.0,
) -> Frame:
    """A frame that saw `points` (M, 2) in the map: each goes to the nearest landmark that is free and in the gate.

    Pairs are kept up to a d^2 of `wide`. What founds a landmark gets the next number from `fresh` on.
    """
    here = np.array(sensor)
    values = polar(here, points)
    found = {(m, n): distance(here, value, *known[n]) for m, value in enumerate(values) for n in known}
    kept = [pair for pair, (squared, _) in found.items() if squared < wide]
    labels, reasons = np.full(len(values), SPURIOUS), np.full(len(values), int(Reason.FOUNDED))
    taken: set[int] = set()
    for pair in sorted(kept, key=lambda pair: found[pair][0]):
        m, n = pair
        if labels[m] != SPURIOUS or reasons[m] == Reason.CONTEST_LOST:
            continue
        if found[pair][0] < GATE:
            reasons[m] = Reason.CONTEST_LOST if n in taken else Reason.NEAREST
            if n not in taken:
                labels[m] = n
                taken.add(n)
        elif found[pair][0] < NEW_GATE and reasons[m] == Reason.FOUNDED:
            reasons[m] = Reason.BETWEEN_GATES
    new = np.flatnonzero(reasons == Reason.FOUNDED)
    labels[new] = fresh + np.arange(len(new))
    spoken = sorted({n for _, n in kept})
    return Frame(
        number=number,
        time=0.2 * number if time is None else time,
        pose=here.copy(),
        sensor=here,
        values=values,
        labels=labels,
        trial=np.isin(labels, trial) | (reasons == Reason.FOUNDED),
        why=Why(
            gate=GATE,
            new_gate=NEW_GATE,
            reasons=reasons,
            pairs=np.array(kept, dtype=np.int64).reshape(-1, 2),
            squared=np.array([found[pair][0] for pair in kept]),
            log_volume=np.array([found[pair][1] for pair in kept]),
            notes=notes,
            managed=managed,
        ),
        landmarks=np.array(spoken, dtype=np.int64),
        positions=np.array([known[n][0] for n in spoken]).reshape(-1, 2),
        spreads=np.array([known[n][1] for n in spoken]).reshape(-1, 2, 2),
        noises=np.broadcast_to(NOISE, (len(values), 2, 2)),
    )


def scattered(
    numbers: range, places: np.ndarray, sigma: float = 0.1
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """A map of landmarks at places, all of them as unsure, and more so across than along the x axis."""
    spread = sigma**2 * np.array([[1.0, 0.3], [0.3, 2.0]])
    return {number: (np.array(place), spread) for number, place in zip(numbers, places, strict=True)}


def easy() -> Frame:
    """Seven landmarks far apart, six of them seen near where they were expected, and one new one."""
    rng = np.random.default_rng(3)
    places = np.array([[12, 8], [20, -6], [8, -14], [26, 10], [5, 21], [16, 1], [28, -12]], dtype=float)
    seen = places[:6] + rng.normal(0.0, 0.15, (6, 2))
    return decide(
        412, scattered(range(7), places), np.vstack([seen, [[14.0, 22.0]]]), sensor=(1.0, -2.0, 0.3)
    )


def contest() -> Frame:
    """Two sightings for one landmark, one between the gates, one with a close rival, and two plain ones."""
    places = np.array([[12.0, 4.0], [20.0, -6.0], [20.8, -6.6], [8.0, -10.0], [25.0, 9.0]])
    seen = np.array([[12.1, 4.1], [12.5, 4.3], [20.4, -6.2], [8.0, -9.1], [25.1, 9.2], [3.0, 15.0]])
    notes = ("case 2: offset 0.12 m, 0.3 deg from 2 pairs",)
    managed = (Managed(4, "confirmed", "3 sightings in 4 frames"),)
    return decide(812, scattered(range(17, 22), places, 0.2), seen, notes=notes, managed=managed, time=162.4)


def nothing() -> Frame:
    """A frame without sightings."""
    return decide(3, {}, np.zeros((0, 2)), sensor=(5.0, 5.0, 1.0))


def cluster(count: int = 20) -> Frame:
    """Twenty sightings of twenty landmarks closer than their gates."""
    rng = np.random.default_rng(8)
    places = np.array([22.0, 6.0]) + rng.uniform(-2.5, 2.5, (count, 2))
    return decide(99, scattered(range(count), places, 0.25), places + rng.normal(0.0, 0.3, (count, 2)))


def drive(frames: int, seed: int = 5, a_frame: int = 7) -> list[Frame]:
    """A run along a row of trees: landmarks founded, confirmed at the second sighting and seen for some time."""
    rng = np.random.default_rng(seed)
    known: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    counts: dict[int, int] = {}
    trail, fresh = [], 0
    for number in range(frames):
        here = (0.5 * number, 0.0, 0.0)
        trees = np.array([[4.0 * k, 6.0 * (-1) ** k] for k in range(number // 8, number // 8 + a_frame)])
        points = trees + rng.normal(0.0, 0.1, trees.shape) + (5.0, 0.0)
        near = {n: known[n] for n in list(known)[-3 * a_frame :]}
        on_trial = tuple(n for n in near if counts[n] < 1)
        frame = decide(number, near, points, sensor=here, fresh=fresh, trial=on_trial)
        happened = []
        for label, reason, point in zip(frame.labels.tolist(), frame.why.reasons.tolist(), points):
            if reason == Reason.FOUNDED:
                known[label], counts[label] = (point, 0.01 * np.eye(2)), 0
                happened.append(Managed(label, "founded", "outside the gate of every landmark"))
                fresh += 1
            elif label >= 0:
                counts[label] += 1
                if counts[label] == 2:
                    happened.append(Managed(label, "confirmed", "information counter 2"))
        why = Why(*(getattr(frame.why, name) for name in Why.__struct_fields__[:-1]), tuple(happened))
        trail.append(Frame(**{name: getattr(frame, name) for name in Frame.__struct_fields__} | {"why": why}))
    return trail


def replaced(frame: Frame, **changes: object) -> Frame:
    """The frame with fields of its own or of its `why` replaced."""
    inside = {name: changes.pop(name) for name in list(changes) if name in Why.__struct_fields__}
    return msgspec.structs.replace(frame, why=msgspec.structs.replace(frame.why, **inside), **changes)


@pytest.fixture(name="trail")
def opened_trail(tmp_path):
    """Writes frames, and opens what was written."""
    opened = []

    def write(*frames, **meta):
        write_audit(tmp_path / AUDIT, frames, meta)
        opened.append(open_audit(tmp_path))
        return opened[-1]

    yield write
    for audit in opened:
        audit.close()
