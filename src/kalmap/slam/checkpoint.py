"""A running filter on disk, exact to the last bit, without pickling."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import msgspec

from kalmap.association import Djnn, Jcbb, KnownIds, Likelihood, Mda, Nearest, Pmb
from kalmap.gaussian import Belief
from kalmap.gaussian.linearisers import BuiltIn
from kalmap.models.motion import BuiltInMotion
from kalmap.models.sensor import RangeBearing
from kalmap.slam.archive import belief_of, opened, read_header, write_archive
from kalmap.slam.window import Pending
from kalmap.slam.window_checkpoint import restore_window

if TYPE_CHECKING:
    from kalmap.perception import Detector
    from kalmap.slam.landmark import LandmarkSlam

FORMAT = "kalmap-filter/2"


class FilterState(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that is not an array."""

    format: str = FORMAT
    motion: BuiltInMotion
    sensor: RangeBearing
    lineariser: BuiltIn
    association: KnownIds | Nearest | Likelihood | Jcbb | Mda | Djnn | Pmb
    scope: str
    coordinates: str
    use: str
    memory: Any
    ids: list[int]
    counts: list[int]
    on_trial: list[int]
    merged: dict[int, int]
    rejected: list[int]
    frames: int
    founded: int
    time: str
    moved: bool
    step_number: int
    pending: bool
    robot: int
    window: list[Pending]


def save_filter(slam: LandmarkSlam, path: str | os.PathLike[str]) -> None:
    """Write atomically. Raises ConfigError if the filter holds a model that kalmap cannot name."""
    belief, n = slam._belief, slam._belief.n
    triangle = belief.packed[: n * (n + 1) // 2]
    write_archive(path, state_of(slam), {"mean": belief.mean[:n], "packed": triangle, "phi": belief.phi})


def load_filter(
    kind: type[LandmarkSlam], path: str | os.PathLike[str], detector: Detector | None
) -> LandmarkSlam:
    """Read what `save_filter` wrote."""
    with opened(path) as stored:
        state = read_header(stored, FilterState, FORMAT)
        belief = belief_of(stored["mean"], stored["packed"], stored["phi"], state.pending)
        return rebuilt(kind, state, belief, detector)


def state_of(slam: LandmarkSlam) -> FilterState:
    """All but the belief."""
    return FilterState(
        motion=slam.motion,  # type: ignore[arg-type]
        sensor=slam.sensor,  # type: ignore[arg-type]
        lineariser=slam.lineariser,  # type: ignore[arg-type]
        association=slam.association,  # type: ignore[arg-type]
        scope=slam.scope,
        coordinates=slam.coordinates,
        use=slam.use,
        memory=slam._memory,
        ids=slam._ids,
        counts=slam._counts,
        on_trial=sorted(slam._on_trial),
        merged=slam.merged,
        rejected=sorted(slam.rejected),
        frames=slam._frames,
        founded=slam._founded,
        time=slam._time.hex(),
        moved=slam._moved,
        step_number=slam.step_number,
        pending=slam._belief.pending,
        robot=slam._belief.robot,
        window=[] if slam._window is None else slam._window.pending,
    )


def rebuilt(
    kind: type[LandmarkSlam], state: FilterState, belief: Belief, detector: Detector | None
) -> LandmarkSlam:
    """The filter. Raises ValueError unless its parts fit together."""
    robot, count = 3 + len(state.motion.biases), len(state.ids)
    if (belief.robot, state.robot, belief.n, len(state.counts)) != (robot, robot, robot + 2 * count, count):
        raise ValueError("its arrays do not fit together")
    slam = kind(
        state.motion,
        state.sensor,
        state.lineariser,
        state.association,
        scope=state.scope,
        coordinates=state.coordinates,
        use=state.use,
        detector=detector,
    )
    slam._belief = belief
    if not slam.association.fits(state.memory, count):
        raise ValueError("the associator's memory does not fit the map")
    slam._memory = state.memory
    slam.merged, slam.rejected, slam._frames = state.merged, set(state.rejected), state.frames
    slam._ids, slam._counts, slam._founded = state.ids, state.counts, state.founded
    slam._on_trial = set(state.on_trial)
    slam._time, slam._moved, slam.step_number = float.fromhex(state.time), state.moved, state.step_number
    restore_window(slam, state.window)
    return slam
