"""The frames that wait for a decision on disk: arrays beside the header, and whether what comes back fits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from kalmap.association.mda import Glance
from kalmap.gaussian import Belief
from kalmap.records import Sightings
from kalmap.slam.window import Pending

if TYPE_CHECKING:
    from kalmap.slam.landmark import LandmarkSlam

_NAME = "array{}"


class _BeliefRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A belief's numbers, without the room to grow."""

    mean: np.ndarray
    packed: np.ndarray
    phi: np.ndarray
    pending: bool


class Writing:
    """Takes the arrays out of what msgspec encodes, and leaves their numbers in it."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}

    def hook(self, value: Any) -> Any:
        """msgspec's `enc_hook`. Raises TypeError for what is no part of a filter that kalmap can name."""
        if isinstance(value, np.ndarray):
            number = len(self.arrays)
            self.arrays[_NAME.format(number)] = value
            return number
        if isinstance(value, Belief):
            n = value.n
            return _BeliefRecord(value.mean[:n], value.packed[: n * (n + 1) // 2], value.phi, value.pending)
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"{type(value).__name__} cannot be written")


class Reading:
    """Puts the arrays back in."""

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.arrays = arrays

    def hook(self, kind: type, value: Any) -> Any:
        """msgspec's `dec_hook`. Raises ValueError for what cannot have been written."""
        if kind is np.ndarray and isinstance(value, int):
            return self.arrays[_NAME.format(value)]
        if kind is Belief:
            record = msgspec.convert(value, _BeliefRecord, dec_hook=self.hook)
            return belief_of(record.mean, record.packed, record.phi, record.pending)
        raise ValueError(f"{value!r} is no {kind.__name__}")


def belief_of(mean: np.ndarray, packed: np.ndarray, phi: np.ndarray, pending: bool) -> Belief:
    """The belief of these numbers. Raises ValueError if they do not fit together."""
    n, robot = len(mean), len(phi)
    _check((mean, (n,)), (packed, (n * (n + 1) // 2,)), (phi, (robot, robot)))
    belief = Belief(mean[:robot], np.zeros((robot, robot)))
    belief.reserve(n)
    belief.mean[:n], belief.packed[: len(packed)], belief.n = mean, packed, n
    belief.phi[:], belief.pending = phi, pending
    return belief


def restore_window(slam: LandmarkSlam, waiting: list[Pending]) -> None:
    """Let frames wait again. Raises ValueError unless they fit the filter and each other."""
    window = slam._window
    if len(waiting) > (0 if window is None else window.association.window - 1):
        raise ValueError("more frames wait than the window holds")
    for f, entry in enumerate(waiting):
        _check_entry(slam, entry, [len(before.frame.values) for before in waiting[:f]])
    if window is not None:
        window.pending = waiting


def _check_entry(slam: LandmarkSlam, entry: Pending, earlier: list[int]) -> None:
    """Raise ValueError unless a frame that waits fits; earlier: (f,) sightings of those before it."""
    before, robot = entry.before, slam._belief.robot
    count, landmarks, controls = len(entry.frame.values), len(before.ids), slam.motion.control_size
    _check_frame(entry.frame, count)
    _check_glance(entry.glance, count, earlier)
    _check((entry.noises, (count, 2, 2)))
    for event in entry.later:
        samples = len(event.durations)
        _check((event.values, (samples, controls)), (event.durations, (samples,)))
        _check((event.covariance, (samples, controls, controls)))
    sizes = (before.belief.robot, entry.tracks.robot, before.belief.n, entry.tracks.n)
    if sizes != (robot, robot, robot + 2 * landmarks, robot + 2 * count):
        raise ValueError("the beliefs of a frame that waits do not fit it")
    if len(before.counts) != landmarks or len(entry.applied) != count:
        raise ValueError("the lists of a frame that waits do not fit it")
    if not slam.association.fits(msgspec.msgpack.decode(before.memory), landmarks):
        raise ValueError("the associator's memory of a frame that waits does not fit the map")


def _check_frame(frame: Sightings, count: int) -> None:
    _check((frame.values, (count, 2)), (frame.covariance, (count, 2, 2)), (frame.ids, (count,), "iu"))
    for values in (frame.attributes or {}).values():
        _check((values, (count,), "iufb"))
    if frame.scan is not None:
        beams = (len(frame.scan.ranges),)
        _check((frame.scan.ranges, beams), (frame.scan.bearings, beams), (frame.scan.intensities, beams))


def _check_glance(glance: Glance, count: int, earlier: list[int]) -> None:
    candidates = len(glance.numbers)
    pair = (count, candidates)
    _check((glance.squared, pair), (glance.log_volume, pair), (glance.missed, (candidates,)))
    _check((glance.trial, (candidates,), "b"), (glance.numbers, (candidates,), "i"))
    for others, link in zip(earlier, glance.links, strict=True):
        _check(*((each, (others, count)) for each in link))


def _check(*arrays: tuple[Any, ...]) -> None:
    """Each: array or None, shape, numpy's kinds of number (any real one if left out). Raises ValueError."""
    for array, shape, *kinds in arrays:
        if array is None:
            continue
        if array.shape != shape or array.dtype.kind not in (kinds[0] if kinds else "iuf"):
            raise ValueError(f"an array is {array.shape} of {array.dtype}, expected {shape}")
