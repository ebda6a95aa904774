"""Why an associator decided as it did: what the audit trail is made of."""

from __future__ import annotations

from enum import IntEnum

import msgspec
import numpy as np


class Reason(IntEnum):
    """Why a sighting went where it went; `REASONS` has the sentence."""

    NEAREST = 2
    ASSIGNED = 3
    JOINT = 4
    WINDOW = 5
    OFFSET = 6
    WIDENED = 7
    FOUNDED = 8
    BETWEEN_GATES = 9
    CONTEST_LOST = 10
    JOINTLY_INCOMPATIBLE = 11
    FALSE_ALARM = 12
    AMBIGUOUS = 13
    PROBABLE = 14
    IMPROBABLE = 15


REASONS: dict[int, str] = {
    Reason.NEAREST: "the nearest landmark inside the gate",
    Reason.ASSIGNED: "part of the best one-to-one assignment inside the gate",
    Reason.JOINT: "part of the largest jointly compatible set",
    Reason.WINDOW: "part of the cheapest assignment over the frames of the window",
    Reason.OFFSET: "the nearest once the offset of the frame was taken off",
    Reason.WIDENED: "nothing matched, so the gate was widened and the offset of the best pair taken off",
    Reason.FOUNDED: "outside the gate of every landmark: founds a new one",
    Reason.BETWEEN_GATES: "too far to match and too near to found a new landmark: left unused",
    Reason.CONTEST_LOST: "another sighting of the frame has the landmark: left unused",
    Reason.JOINTLY_INCOMPATIBLE: "possible alone, but not together with the rest of the frame: left unused",
    Reason.FALSE_ALARM: "cheaper as a false alarm over the frames of the window: left unused",
    Reason.AMBIGUOUS: "another landmark is nearly as likely: left unused",
    Reason.PROBABLE: "nearly sure over all likely associations of the frame",
    Reason.IMPROBABLE: "not sure enough over all likely associations of the frame: left unused",
}


class Managed(msgspec.Struct, frozen=True):
    """Something that happened to a landmark.

    landmark: its index in the map when an associator says it, its lasting number in a `Frame`.
    action: "founded", "confirmed", "retired" or "merged". why: in words. into: the other landmark of a merger, else -1.
    """

    landmark: int
    action: str
    why: str
    into: int = -1


class Why(msgspec.Struct, frozen=True):
    """What an associator looked at in one frame of M sightings.

    gate, new_gate: squared Mahalanobis distances of its gates.
    reasons: (M,) `Reason` of each sighting's fate.
    pairs: (K, 2) int64, sighting and landmark of every pair that was considered: an index of the map when an
        associator says it, a lasting number in a `Frame`. squared, log_volume: (K,) d^2 and ln det S of them.
    notes: what is true of the whole frame ("case 2: offset 0.12 m, 0.3 deg").
    managed: what happened to landmarks.
    """

    gate: float
    new_gate: float
    reasons: np.ndarray
    pairs: np.ndarray
    squared: np.ndarray
    log_volume: np.ndarray
    notes: tuple[str, ...] = ()
    managed: tuple[Managed, ...] = ()


class Frame(msgspec.Struct, frozen=True):
    """One frame of the audit trail: what was seen, from where, and what was decided.

    number: counted from 0. time: s. pose: (3,) predicted, before the frame was used; sensor: (3,) the sensor's own.
    values: (M, 2) range m, bearing rad. labels: (M,) lasting number of the landmark that each sighting was given to,
    also where it founded it; SPURIOUS where it was left unused. trial: (M,) bool, whether that landmark was still on
    trial afterwards. why: with lasting numbers in place of indices.
    landmarks: (L,) lasting numbers of the landmarks that the pairs speak of; positions (L, 2) m and spreads (L, 2, 2),
    the covariance of where each was expected to be seen, in metres in the map frame, sensor noise left out.
    noises: (M, 2, 2) covariance of each sighting's range and bearing as the filter took it; None where it was not kept.
    """

    number: int
    time: float
    pose: np.ndarray
    sensor: np.ndarray
    values: np.ndarray
    labels: np.ndarray
    trial: np.ndarray
    why: Why
    landmarks: np.ndarray
    positions: np.ndarray
    spreads: np.ndarray
    noises: np.ndarray | None = None
