"""Decisions that wait: a filter that can go back to before a frame and take it again with another association."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import msgspec
import numpy as np

from kalmap.association import Expected
from kalmap.association.assignment import Assigned
from kalmap.association.mda import UNUSED, Glance, Key, Mda
from kalmap.gaussian import Belief
from kalmap.records import NEW, SPURIOUS, Association, ConfigError, Frame, Odometry, Sightings
from kalmap.slam.map_state import MapRecord
from kalmap.slam.predicted import distances_between

if TYPE_CHECKING:
    from kalmap.slam.landmark import LandmarkSlam

Revisions = dict[int, tuple[np.ndarray, Frame | None]]
"""Frame number -> its new labels (M,) and its new entry in the audit trail."""


class Pending(msgspec.Struct, forbid_unknown_fields=True):
    """A frame that is not decided for good: the filter before it, the frame, what it looked like, and what came after.

    noises: (M, 2, 2). tracks: a small map of the frame's own, a landmark for each of its sightings, carried along
    by the odometry. applied: (M) the lasting number of the landmark that each sighting was taken for, SPURIOUS for
    none. later: the odometry until the next frame.
    """

    before: MapRecord
    frame: Sightings
    noises: np.ndarray
    glance: Glance
    tracks: Belief
    applied: list[int] = []
    later: list[Odometry] = []


class Window:
    """The frames that wait for a decision, and how it is carried out.

    Raises ConfigError for a sensor without a finite range, over which no false alarms can be spread evenly.
    """

    def __init__(self, slam: LandmarkSlam) -> None:
        if not 0.0 < getattr(slam.sensor, "max_range", math.inf) < math.inf:
            raise ConfigError(
                "association.method: mda spreads false sightings over the sensor's finite max_range"
            )
        self.slam = slam
        self.pending: list[Pending] = []
        self._coming: Pending | None = None
        self._numbers: dict[Key, int] = {}  # tracks of the window -> lasting numbers of what they founded

    @property
    def association(self) -> Mda:
        """The filter's own."""
        return cast(Mda, self.slam.association)

    def moved(self, event: Odometry) -> None:
        """Odometry between frames: kept, and carried to the frames' own maps."""
        for entry in self.pending:
            self.slam._engine.predict(entry.tracks, event)
        if self.pending:
            self.pending[-1].later.append(event)

    def decide(self, frame: Sightings, noises: np.ndarray) -> tuple[Association, Revisions]:
        """Decide on the window with a frame that has come now, and carry out what is revised of earlier ones.

        Returns the decision on the frame itself, which is to be carried out now, and what changed of others.
        """
        slam, method = self.slam, self.association
        links = tuple(self._link(entry, frame, noises) for entry in self.pending)
        predicted = slam.predicted(frame, noises)
        glance = method.glance(slam._memory, frame, predicted, links)
        keys, assigned = method.explain_window([*(entry.glance for entry in self.pending), glance], predicted)
        notes = (_note(assigned, len(keys)),) if slam.explain else ()
        revised = self._revise(keys[:-1])
        if revised:
            glance = method.glance(slam._memory, frame, slam.predicted(frame, noises), links)
        self._coming = Pending(slam.snapshot(), frame, noises, glance, _tracks(slam, frame, noises))
        return self._conclude(self._coming, keys[-1], True, notes), revised

    def keep(self) -> None:
        """The frame decided last has been taken: it waits from now on, and the oldest perhaps no more."""
        assert self._coming is not None
        self._taken(self._coming)
        self.pending.append(self._coming)
        self._coming = None
        if len(self.pending) >= self.association.window:
            self.pending.pop(0)
            for entry in self.pending:  # what links them to the frame that is gone
                entry.glance = msgspec.structs.replace(entry.glance, links=entry.glance.links[1:])

    def _revise(self, keys: list[list[Key]]) -> Revisions:
        """Go back to the first frame that is decided differently now and take everything from there again."""
        slam, self._numbers = self.slam, {}
        begin = 0
        while begin < len(keys) and not self._differs(begin, keys[begin]):
            self._name_tracks(begin, keys[begin])
            begin += 1
        revised: Revisions = {}
        for f in range(begin, len(keys)):
            entry = self.pending[f]
            if f == begin:
                slam.restore(entry.before)
            else:
                entry.before = slam.snapshot()
                predicted = slam.predicted(entry.frame, entry.noises)
                entry.glance = self.association.glance(
                    slam._memory, entry.frame, predicted, entry.glance.links
                )
            number = slam._frames
            again = ("taken again",) if slam.explain else ()
            slam.take_decided(entry.frame, entry.noises, self._conclude(entry, keys[f], False, again))
            self._taken(entry)
            self._name_tracks(f, keys[f])
            revised[number] = slam.frame_labels, slam.frame_decision
            for event in entry.later:
                slam._engine.predict(slam._belief, event)
        return revised

    def _differs(self, f: int, keys: list[Key]) -> bool:
        """Whether the frame would now be taken otherwise: another landmark, or new instead of false and the reverse."""
        entry = self.pending[f]
        for key, then in zip(keys, entry.applied, strict=True):
            if key[0] == f:
                same = then >= entry.glance.founded
            elif key[0] == UNUSED[0]:
                same = then == SPURIOUS
            else:
                same = then == (key[1] if key[0] < 0 else self._numbers.get(key, NEW))
            if not same:
                return True
        return False

    def _name_tracks(self, f: int, keys: list[Key]) -> None:
        """Remember the landmarks of the tracks that began in a frame."""
        for i, key in enumerate(keys):
            if key == (f, i) and self.pending[f].applied[i] >= 0:
                self._numbers[key] = self.pending[f].applied[i]

    def _conclude(self, entry: Pending, keys: list[Key], newest: bool, notes: tuple[str, ...]) -> Association:
        """The association that gives the frame's sightings to the landmarks of these keys."""
        slam, frame = self.slam, entry.frame
        place = {number: index for index, number in enumerate(slam._ids)}
        entry.applied = [key[1] if key[0] == -1 else self._numbers.get(key, NEW) for key in keys]
        wanted: list[int] = []
        for key, number in zip(keys, entry.applied):
            index = SPURIOUS if key == UNUSED else place.get(slam.last_number(number), NEW)
            # two landmarks of the window may have become one since
            wanted.append(SPURIOUS if index >= 0 and index in wanted else index)
        predicted = slam.predicted(frame, entry.noises)
        return self.association.conclude(slam._memory, frame, predicted, wanted, newest, notes)

    def _taken(self, entry: Pending) -> None:
        """A frame has just been taken: what no landmark was named for has what it was given."""
        labels = self.slam.frame_labels.tolist()
        entry.applied = [label if number < 0 else number for number, label in zip(entry.applied, labels)]

    def _link(self, entry: Pending, frame: Sightings, noises: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M_earlier, M) squared distances and ln det S of sightings from where earlier ones point."""
        tracks, indices = entry.tracks, np.arange(len(entry.frame.values))
        expected = Expected(indices, *self.slam._engine.expect(tracks, tracks.robot + 2 * indices))
        expected = expected.widened(self.association.extent)
        squared, log_volume = distances_between(frame.values, noises, expected)
        return squared.T + self.association.told_apart(entry.frame, frame), log_volume.T


def _tracks(slam: LandmarkSlam, frame: Sightings, noises: np.ndarray) -> Belief:
    """A map of the frame alone: the robot where it is thought to be, for certain, and a landmark for each sighting."""
    belief = slam._belief
    block = belief.robot_covariance()
    block[:3, :] = block[:, :3] = 0.0  # only motion from here on matters
    tracks = Belief(belief.mean[: belief.robot], block)
    slam._engine.append(tracks, frame.values, noises)
    return tracks


def _note(assigned: Assigned, frames: int) -> str:
    return f"assignment over {frames} frames costs {assigned.cost:.2f}, at most {assigned.gap:.2g} more than the least"
