"""A running filter on disk, exact to the last bit, without pickling."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from kalmap.association import Djnn, Jcbb, KnownIds, Likelihood, Mda, Nearest, Pmb
from kalmap.gaussian import Belief
from kalmap.gaussian.linearisers import BuiltIn
from kalmap.models.motion import BuiltInMotion
from kalmap.models.sensor import RangeBearing
from kalmap.records import ConfigError, LogError
from kalmap.slam.window import Pending
from kalmap.slam.window_checkpoint import Reading, Writing, belief_of, restore_window

if TYPE_CHECKING:
    from kalmap.perception import Detector
    from kalmap.slam.landmark import LandmarkSlam

FORMAT = "kalmap-filter/2"


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
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
    belief, n, writing = slam._belief, slam._belief.n, Writing()
    try:
        header = msgspec.msgpack.encode(
            _State(
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
                pending=belief.pending,
                robot=belief.robot,
                window=[] if slam._window is None else slam._window.pending,
            ),
            enc_hook=writing.hook,
        )
        msgspec.msgpack.decode(header, type=_State, dec_hook=Reading(writing.arrays).hook)
    except (TypeError, msgspec.ValidationError) as problem:
        raise ConfigError(
            f"this filter holds a part that is not built in and cannot be saved: {problem}"
        ) from problem
    buffer = io.BytesIO()
    triangle = belief.packed[: n * (n + 1) // 2]
    text = np.frombuffer(header, dtype=np.uint8)
    arrays = {"header": text, "mean": belief.mean[:n], "packed": triangle, "phi": belief.phi} | writing.arrays
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    partial.write_bytes(buffer.getvalue())
    os.replace(partial, target)


def load_filter(
    kind: type[LandmarkSlam], path: str | os.PathLike[str], detector: Detector | None
) -> LandmarkSlam:
    """Read what `save_filter` wrote."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            header = stored["header"].tobytes()
            state = msgspec.msgpack.decode(header, type=_State, dec_hook=Reading(stored).hook)
            belief = belief_of(stored["mean"], stored["packed"], stored["phi"], state.pending)
        return _rebuild(kind, state, belief, detector)
    except FileNotFoundError:
        raise LogError("no such file", file=path) from None
    except (*_DAMAGE, ConfigError) as problem:
        raise LogError(f"is no saved filter of kalmap, or is damaged ({problem})", file=path) from problem


# what numpy and zipfile raise on files that are something else or have been damaged, beside their own errors
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
    msgspec.MsgspecError,
)


def _rebuild(
    kind: type[LandmarkSlam], state: _State, belief: Belief, detector: Detector | None
) -> LandmarkSlam:
    """The filter, if its parts fit together."""
    if state.format != FORMAT:
        raise ValueError(f"format {state.format!r}, expected {FORMAT!r}")
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
