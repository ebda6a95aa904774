"""Divide and conquer over a landmark filter: the filter only ever holds the local map that it is in."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from kalmap.association import Mda
from kalmap.geometry.se2 import compose
from kalmap.models import MotionModel, SensorModel
from kalmap.records import (
    SPURIOUS,
    ConfigError,
    DivideConfig,
    Estimate,
    Event,
    Frame,
    Landmarks,
    Odometry,
    Sightings,
    Trajectory,
)
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.submaps.background import BackgroundForest
from kalmap.slam.submaps.finished import Finished, finished
from kalmap.slam.submaps.forest import Forest, chain, composed
from kalmap.slam.submaps.joiner import ById, LandmarkJoiner
from kalmap.slam.submaps.local_map import LocalMap, local_map
from kalmap.slam.submaps.newest import newest
from kalmap.slam.submaps.pairing import ByPlace
from kalmap.slam.window import Revisions

if TYPE_CHECKING:
    from kalmap.perception import Detector

_GATE = 0.9999
_TOLERANCE = 1e-6  # of joins under way, a thousandth of a standard deviation; the end is solved to rounding


class Passed(msgspec.Struct):
    """The drive, frame by frame: time s, which local map it was in, pose in that and covariance."""

    times: list[float] = []
    parts: list[int] = []
    poses: list[np.ndarray] = []
    covariances: list[np.ndarray] = []


class DivideAndConquer:
    """Landmark SLAM in local maps (Paz, Tardos & Neira 2008).

    slam: a fresh filter, whose settings every local map's filter has; its start is the drive's. settings: when a
    local map is closed, how maps are joined. A step costs what a step in a local map costs, however large the whole
    has become; a frame that closes a map pays for joins that carry, unless they run in the background.

    What a local map has learnt of the vehicle's constant errors (the motion model's biases) the next one begins with.
    That is the one thing maps share, and joins leave it out of account: once a map or two have been closed, what is
    still unsure of a constant error is little beside what the drive adds.
    """

    numbers_per_sighting = 2  # range and bearing

    def __init__(self, slam: LandmarkSlam, settings: DivideConfig | None = None) -> None:
        if isinstance(slam.association, Mda):
            raise ConfigError("divide: mda looks back over frames of a map that may be closed")
        self.settings = DivideConfig(on=True) if settings is None else settings
        self.start, self.start_covariance = slam.pose, slam.pose_covariance
        self.live = slam.successor()
        self._forest = self._new_forest()
        self._passed = Passed()
        self._closed, self._distance = 0, 0.0  # maps closed; m driven in the one that is open
        self._base: tuple[tuple[LocalMap, ...], np.ndarray, np.ndarray] | None = None
        self._finished: tuple[Any, Finished] | None = None
        self._merged: dict[int, int] = {}
        self._rejected: set[int] = set()

    def _new_forest(
        self, trees: Any = (), refusals: int = 0
    ) -> Forest[LocalMap] | BackgroundForest[LocalMap]:
        known = self.live.association.uses_ids
        gate = self.settings.gate or (1.0 if known else _GATE)
        joiner = LandmarkJoiner(ById() if known else ByPlace(), gate, self.settings.dense_limit, _TOLERANCE)
        kind = BackgroundForest if self.settings.background else Forest
        return kind(joiner, trees, refusals)

    # --- the filter -------------------------------------------------------------------------------------------

    def step(self, event: Event) -> None:
        """Take one event. One that cannot be used raises EventError and changes nothing."""
        before, frames = self.live.pose[:2], self.live.frames_taken
        self.live.step(event)
        if isinstance(event, Odometry):
            self._distance += float(np.hypot(*(self.live.pose[:2] - before)))
        if self.live.frames_taken == frames:
            return
        self._note()
        full = self.live.landmark_count >= self.settings.close_landmarks
        if (full or self._distance >= self.settings.close_distance) and self._uncertain():
            self.close()

    def _note(self) -> None:
        passed = self._passed
        passed.times.append(self.live.time)
        passed.parts.append(self._closed)
        passed.poses.append(self.live.pose)
        passed.covariances.append(self.live.pose_covariance)

    def _uncertain(self) -> bool:
        """Whether the pose is uncertain in every direction: a map whose end is exact ties two maps without a give."""
        try:
            np.linalg.cholesky(self.live.pose_covariance)
        except np.linalg.LinAlgError:
            return False
        return True

    def close(self) -> None:
        """Close the local map here and begin the next at its end."""
        closed = self._local_map()
        self._keep_numbers()
        self.live = self.live.successor()
        self._closed, self._distance = self._closed + 1, 0.0
        self._forest.close(closed)

    def _local_map(self) -> LocalMap:
        """The open map as it would be closed. What is `extent` wide has a place of its own in every map that saw it."""
        mean, covariance, ids, sightings = self.live.confirmed_map()
        own = (
            0.5 * getattr(self.live.association, "extent", 0.0) ** 2
        )  # of each of two maps that are compared
        covariance[np.arange(3, len(mean)), np.arange(3, len(mean))] += own
        return local_map(mean, covariance, ids, sightings)

    def _keep_numbers(self) -> None:
        """What the closed map's labels have to be told later."""
        self._merged.update(self.live.merged)
        self._rejected |= self.live.rejected | self.live.on_trial

    # --- what it says -----------------------------------------------------------------------------------------

    def _placed(self) -> tuple[np.ndarray, np.ndarray]:
        """T_map_start of the open local map and its covariance, in the newest joined frame."""
        maps = self._forest.maps
        if self._base is None or self._base[0] != maps:
            known = self.live.association.uses_ids
            tied = newest(maps, self.settings.gate or 1.0) if known else chain(maps)
            pose, covariance = composed(self.start, self.start_covariance, *tied)
            self._base = maps, pose, covariance
        return self._base[1], self._base[2]

    @property
    def pose(self) -> np.ndarray:
        """(3,) x m, y m, heading rad in the newest joined frame."""
        return compose(self._placed()[0], self.live.pose)

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3)."""
        return composed(*self._placed(), self.live.pose, self.live.pose_covariance)[1]

    @property
    def landmark_count(self) -> int:
        """How many landmarks there are in all maps; one that two maps not yet joined hold counts twice."""
        return sum(map(len, self._forest.maps)) + self.live.landmark_count

    @property
    def maps_closed(self) -> int:
        """How many local maps have been closed."""
        return self._closed

    @property
    def refusals(self) -> int:
        """How many joins were refused."""
        return self._settled().refusals

    def _settled(self) -> Forest[LocalMap]:
        return self._forest.settled() if isinstance(self._forest, BackgroundForest) else self._forest

    def finished(self) -> Finished:
        """Everything joined, the open local map too, which goes on as it is. Waits for the background."""
        now = (self._closed, self.live.step_number, self.live.frames_taken, self.live.time)
        if self._finished is None or self._finished[0] != now:
            done = finished(self._settled(), self._local_map(), self.start, self.start_covariance)
            self._finished = now, done
        return self._finished[1]

    def estimate(self) -> Estimate:
        """A snapshot in the frame of the whole drive, all loops closed: as much work as a join of everything."""
        done = self.finished()
        landmarks = Landmarks(
            ids=done.ids,
            positions=done.landmarks,
            covariances=done.landmark_covariances,
            sightings=done.sightings,
            existence=np.ones(len(done.ids)),
        )
        size = len(self.live.motion.biases)
        live = self.live.estimate()
        joint = done.joint if not size else _with_biases(done, live)
        return Estimate(
            time=self.live.time,
            pose=done.pose,
            covariance=done.covariance,
            landmarks=landmarks,
            biases=live.biases,
            joint=joint,
            coordinates="additive",
            trajectory=self.trajectory(),
        )

    def trajectory(self) -> Trajectory:
        """Where the vehicle was at every frame, as it is seen now."""
        done, passed = self.finished(), self._passed
        count, parts = len(passed.times), np.array(passed.parts, dtype=np.int64)
        local = np.array(passed.poses).reshape(count, 3), np.array(passed.covariances).reshape(count, 3, 3)
        poses, covariances = composed(done.starts[parts], done.start_covariances[parts], *local)
        return Trajectory(np.array(passed.times), poses, covariances)

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """Labels given during the run as the map has them now: joins and mergers followed."""
        merged = self._merged | self.live.merged | dict(self.finished().aliases.tolist())
        gone = self._rejected | self.live.rejected | self.live.on_trial
        settled = labels.copy()
        for number in np.unique(labels[labels >= 0]).tolist():
            last = number
            while last in merged:
                last = merged[last]
            settled[labels == number] = SPURIOUS if last in gone else last
        return settled

    # --- what its filter says ---------------------------------------------------------------------------------

    @property
    def explain(self) -> bool:
        return self.live.explain

    @explain.setter
    def explain(self, wanted: bool) -> None:
        self.live.explain = wanted

    @property
    def labels(self) -> bool:
        return self.live.labels

    @property
    def frame_nis(self) -> float:
        return self.live.frame_nis

    @property
    def frame_used(self) -> int:
        return self.live.frame_used

    @property
    def frame_sightings(self) -> Sightings | None:
        return self.live.frame_sightings

    @property
    def frame_labels(self) -> np.ndarray:
        return self.live.frame_labels

    @property
    def frame_decision(self) -> Frame | None:
        return self.live.frame_decision

    @property
    def frame_revisions(self) -> Revisions:
        return {}

    @property
    def association_seconds(self) -> float:
        return self.live.association_seconds

    @property
    def motion(self) -> MotionModel:
        return self.live.motion

    @property
    def sensor(self) -> SensorModel:
        return self.live.sensor

    @property
    def time(self) -> float:
        return self.live.time

    @property
    def frames_taken(self) -> int:
        return self.live.frames_taken

    @property
    def attribute_names(self) -> tuple[str, ...]:
        return self.live.attribute_names

    def twin(self) -> DivideAndConquer:
        """A fresh estimator with the same settings."""
        return DivideAndConquer(self.live.twin(), self.settings)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that it knows, so that `load` goes on bit for bit. Waits for the background."""
        from kalmap.slam.submaps.divide_checkpoint import save_divided

        save_divided(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, detector: Detector | None = None) -> DivideAndConquer:
        """What `save` wrote. Raises LogError if the file is not one of these or is damaged."""
        from kalmap.slam.submaps.divide_checkpoint import load_divided

        return load_divided(cls, path, detector)


def _with_biases(done: Finished, live: Estimate) -> Any:
    """The joint of pose, biases and landmarks: biases are the open local map's own, apart from the rest."""

    def joint() -> tuple[np.ndarray, np.ndarray]:
        mean, covariance = done.joint()
        values = np.array(list(live.biases.values())).reshape(-1, 2)
        n, b = len(mean), len(values)
        kept = np.concatenate([np.arange(3), 3 + b + np.arange(n - 3)])
        whole = np.zeros((n + b, n + b))
        whole[np.ix_(kept, kept)] = covariance
        whole[3 + np.arange(b), 3 + np.arange(b)] = values[:, 1] ** 2
        return np.concatenate([mean[:3], values[:, 0], mean[3:]]), whole

    return joint
