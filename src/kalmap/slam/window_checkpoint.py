"""The frames that wait for a decision on disk: whether what comes back fits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from kalmap.association.mda import Glance
from kalmap.records import Sightings
from kalmap.slam.archive import check_arrays
from kalmap.slam.window import Pending

if TYPE_CHECKING:
    from kalmap.slam.landmark import LandmarkSlam


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
    check_arrays((entry.noises, (count, 2, 2)))
    for event in entry.later:
        samples = len(event.durations)
        check_arrays((event.values, (samples, controls)), (event.durations, (samples,)))
        check_arrays((event.covariance, (samples, controls, controls)))
    sizes = (before.belief.robot, entry.tracks.robot, before.belief.n, entry.tracks.n)
    if sizes != (robot, robot, robot + 2 * landmarks, robot + 2 * count):
        raise ValueError("the beliefs of a frame that waits do not fit it")
    if len(before.counts) != landmarks or len(entry.applied) != count:
        raise ValueError("the lists of a frame that waits do not fit it")
    if not slam.association.fits(msgspec.msgpack.decode(before.memory), landmarks):
        raise ValueError("the associator's memory of a frame that waits does not fit the map")


def _check_frame(frame: Sightings, count: int) -> None:
    check_arrays((frame.values, (count, 2)), (frame.covariance, (count, 2, 2)), (frame.ids, (count,), "iu"))
    for values in (frame.attributes or {}).values():
        check_arrays((values, (count,), "iufb"))
    if frame.scan is not None:
        beams = (len(frame.scan.ranges),)
        check_arrays(
            (frame.scan.ranges, beams), (frame.scan.bearings, beams), (frame.scan.intensities, beams)
        )


def _check_glance(glance: Glance, count: int, earlier: list[int]) -> None:
    candidates = len(glance.numbers)
    pair = (count, candidates)
    check_arrays((glance.squared, pair), (glance.log_volume, pair), (glance.missed, (candidates,)))
    check_arrays((glance.trial, (candidates,), "b"), (glance.numbers, (candidates,), "i"))
    for others, link in zip(earlier, glance.links, strict=True):
        check_arrays(*((each, (others, count)) for each in link))
