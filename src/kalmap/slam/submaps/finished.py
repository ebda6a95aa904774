"""What a forest of landmark maps comes to: one map, placed where the drive began."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from kalmap.gaussian.roots import NotPositiveError
from kalmap.geometry.se2 import compose, quarter_turn, rotate
from kalmap.records import JointTooLargeError
from kalmap.slam.submaps.forest import Forest
from kalmap.slam.submaps.joiner import chained, relinearised
from kalmap.slam.submaps.local_map import LocalMap
from kalmap.slam.submaps.recovery import Recovery

_TOLERANCE = 1e-10  # a hundred-thousandth of a standard deviation
JOINT_LIMIT = 12_000  # numbers in a joint covariance: 1.2 GB, and as much again while it is written


class Finished(msgspec.Struct, frozen=True, eq=False):
    """A whole map. starts: (K, 3) T_map_part of its local maps, start_covariances (K, 3, 3). rest as in `Estimate`.

    ids, landmarks, sightings: of N different landmarks. joint: mean and covariance of pose and landmarks. apart: how
    many maps still stood side by side, their joins refused: 1 where all is one.
    """

    pose: np.ndarray
    covariance: np.ndarray
    ids: np.ndarray
    landmarks: np.ndarray
    landmark_covariances: np.ndarray
    sightings: np.ndarray
    starts: np.ndarray
    start_covariances: np.ndarray
    aliases: np.ndarray
    joint: Callable[[], tuple[np.ndarray, np.ndarray]]
    apart: int


def finished(
    forest: Forest[LocalMap], last: LocalMap, start: np.ndarray, start_covariance: np.ndarray
) -> Finished:
    """Join everything, `last` behind what the forest holds, and solve it again from all its parts.

    The forest itself stays as it is. start: (3,) T_map_start and its covariance.
    """
    copy = Forest(forest.joiner, forest.trees, forest.refusals)
    copy.close(last)
    copy.finish()
    whole, apart = copy.maps[0], len(copy.maps)
    for each in copy.maps[1:]:
        whole = chained(whole, each)
    try:
        whole = relinearised(whole, _TOLERANCE)
    except NotPositiveError:  # a part without noise in some direction: the full covariance is all there is
        whole.dense()
    return _placed(whole, apart, start, start_covariance)


def _placed(whole: LocalMap, apart: int, start: np.ndarray, start_covariance: np.ndarray) -> Finished:
    frames, landmark_covariances, joint = _covariances(whole)
    poses = np.concatenate([np.zeros((1, 3)), whole.frames, whole.end[None]])
    placed = compose(start, poses)
    points = start[:2] + rotate(start[2], whole.landmarks)
    turn = np.eye(3)
    turn[:2, :2] = _rotation(start[2])
    by_start = _moved_by(placed[:, :2] - start[:2], 3)
    pose_covariances = turn @ frames @ turn.T + by_start @ start_covariance @ by_start.transpose(0, 2, 1)
    by_start = _moved_by(points - start[:2], 2)
    turned = turn[:2, :2] @ landmark_covariances @ turn[:2, :2].T
    turned = turned + by_start @ start_covariance @ by_start.transpose(0, 2, 1)
    _, kept = np.unique(whole.ids, return_index=True)  # one that two maps apart both hold stands once
    kept = np.sort(kept)

    def joint_in_map() -> tuple[np.ndarray, np.ndarray]:
        size = 3 + 2 * len(kept)
        if size > JOINT_LIMIT:
            raise JointTooLargeError(f"a joint covariance of {size} numbers is too large to be written out")
        covariance = joint(kept)
        matrix = np.zeros((size, size))
        matrix[:3, :3] = turn
        for place in range(3, size, 2):
            matrix[place : place + 2, place : place + 2] = turn[:2, :2]
        covariance = matrix @ covariance @ matrix.T
        by_start = np.concatenate(
            [_moved_by(placed[-1:, :2] - start[:2], 3)[0], *_moved_by(points[kept] - start[:2], 2)]
        )
        covariance = covariance + by_start @ start_covariance @ by_start.T
        return np.concatenate([placed[-1], points[kept].ravel()]), 0.5 * (covariance + covariance.T)

    return Finished(
        pose=placed[-1],
        covariance=pose_covariances[-1],
        ids=whole.ids[kept],
        landmarks=points[kept],
        landmark_covariances=turned[kept],
        sightings=whole.sightings[kept],
        starts=placed[:-1],
        start_covariances=pose_covariances[:-1],
        aliases=whole.aliases,
        joint=joint_in_map,
        apart=apart,
    )


def _covariances(whole: LocalMap) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """(K + 1, 3, 3) of starts and end, (N, 2, 2) of landmarks, and how to come by the joint one of end and some."""
    poses, first = len(whole.frames) + 1, 3 * len(whole.frames)
    if whole.covariance is None:
        recovery = Recovery(whole)
        frames, landmarks = recovery.frames(), recovery.landmarks()

        def joint(rows: np.ndarray) -> np.ndarray:
            return recovery.joint(np.array([poses - 1]), rows)
    else:
        full = whole.covariance
        i = 3 * np.arange(poses)[:, None] + np.arange(3)
        frames = full[i[:, :, None], i[:, None, :]]
        i = first + 3 + 2 * np.arange(len(whole))[:, None] + np.arange(2)
        landmarks = full[i[:, :, None], i[:, None, :]]

        def joint(rows: np.ndarray) -> np.ndarray:
            entries = np.concatenate([first + np.arange(3), i[rows].ravel()])
            return full[np.ix_(entries, entries)]

    return np.concatenate([np.zeros((1, 3, 3)), frames]), landmarks, joint


def _moved_by(levers: np.ndarray, size: int) -> np.ndarray:
    """(K, size, 3): how poses (3) or points (2) move with the pose that they are seen from, `levers` (K, 2) away."""
    matrices = np.zeros((len(levers), size, 3))
    matrices[:, :2, :2] = np.eye(2)
    matrices[:, :2, 2] = quarter_turn(levers)
    matrices[:, 2:, 2] = 1.0
    return matrices


def _rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
