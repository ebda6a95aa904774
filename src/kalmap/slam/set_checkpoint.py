"""A running finite-set filter on disk: particles, maps, rates and the generator, exact to the last bit."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.gaussian import Belief
from kalmap.kernels.set_layout import COLUMNS
from kalmap.models.motion import BuiltInMotion
from kalmap.models.sensor import RangeBearing
from kalmap.records import ConfigError, FiniteSetConfig
from kalmap.slam.archive import check_arrays, opened, read_header, write_archive
from kalmap.slam.set_rules import RINGS, Rates

if TYPE_CHECKING:
    from kalmap.perception import Detector
    from kalmap.slam.finite_set import FiniteSetSlam

FORMAT = "kalmap-set-filter/1"
_GENERATOR = "PCG64"


class _Random(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """numpy's own generator; state, inc: 128 bits in hexadecimal."""

    state: str
    inc: str
    has_uint32: int
    uinteger: int


class _Cloud(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The particles, see `Particles`; blocks without the room to grow. left: what a frame leaves of each one's pose."""

    poses: np.ndarray
    biases: np.ndarray
    log_weights: np.ndarray
    slots: np.ndarray
    blocks: np.ndarray
    counts: np.ndarray
    left: np.ndarray


class _Way(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The way since the last frame, see `Ahead`."""

    belief: Belief
    reference: np.ndarray
    covariance: np.ndarray


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that the filter knows."""

    format: str = FORMAT
    motion: BuiltInMotion
    sensor: RangeBearing
    config: FiniteSetConfig
    extent: float
    random: _Random
    cloud: _Cloud
    rates: Rates
    way: _Way
    pose: np.ndarray
    spread: np.ndarray
    numbers: dict[int, int]
    count: int
    time: str
    moved: bool
    frames: int
    step_number: int
    best: int
    resampled: int
    recovered: int


def save_set_filter(slam: FiniteSetSlam, path: str | os.PathLike[str]) -> None:
    """Write atomically. Raises ConfigError if the filter holds a part that kalmap cannot name."""
    ahead = slam._ahead
    state = _State(
        motion=slam.motion,
        sensor=slam.sensor,
        config=slam.config,
        extent=float(slam.extent),
        random=_random_of(slam.rng),
        cloud=_cloud_of(slam),
        rates=slam.rates,
        way=_Way(ahead.belief, ahead.reference, ahead.covariance),
        pose=slam._pose,
        spread=slam._spread,
        numbers=slam._numbers,
        count=slam._count,
        time=slam._time.hex(),
        moved=slam._moved,
        frames=slam.frames_taken,
        step_number=slam.step_number,
        best=slam.best,
        resampled=slam.resampled,
        recovered=slam.recovered,
    )
    write_archive(path, state)


def load_set_filter(
    kind: type[FiniteSetSlam], path: str | os.PathLike[str], detector: Detector | None
) -> FiniteSetSlam:
    """Read what `save_set_filter` wrote. Raises LogError if the file is not one of these or is damaged."""
    with opened(path) as stored:
        state = read_header(stored, _State, FORMAT)
        _check(state)
        return _rebuilt(kind, state, detector)


def _random_of(rng: np.random.Generator) -> _Random:
    state = rng.bit_generator.state
    if state["bit_generator"] != _GENERATOR:
        raise ConfigError(
            f"this filter draws by {state['bit_generator']} and cannot be saved: expected {_GENERATOR}"
        )
    inner = state["state"]
    return _Random(f"{inner['state']:x}", f"{inner['inc']:x}", state["has_uint32"], state["uinteger"])


def _generator(random: _Random) -> np.random.Generator:
    """Raises ValueError for what is no state."""
    state, inc = int(random.state, 16), int(random.inc, 16)
    if not (0 <= state < 2**128 and 0 <= inc < 2**128 and random.has_uint32 in (0, 1)):
        raise ValueError("the state of its generator is none")
    if not 0 <= random.uinteger < 2**32:
        raise ValueError("the state of its generator is none")
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = {
        "bit_generator": _GENERATOR,
        "state": {"state": state, "inc": inc},
        "has_uint32": random.has_uint32,
        "uinteger": random.uinteger,
    }
    return rng


def _cloud_of(slam: FiniteSetSlam) -> _Cloud:
    particles = slam._particles
    used = int(particles.counts.max(initial=0))
    return _Cloud(
        particles.poses,
        particles.biases,
        particles.log_weights,
        particles.slots,
        np.ascontiguousarray(particles.blocks[:, :used]),
        particles.counts,
        slam._left,
    )


def _check(state: _State) -> None:
    """Raise ValueError unless the arrays fit the settings and each other."""
    cloud, number, biases = state.cloud, state.config.particles, len(state.motion.biases)
    maps = len(cloud.counts)
    check_arrays((cloud.poses, (number, 3), "f"), (cloud.biases, (number, biases), "f"))
    check_arrays((cloud.log_weights, (number,), "f"), (cloud.slots, (number,), "i"))
    check_arrays((cloud.left, (number, 3, 3), "f"), (cloud.counts, (maps,), "i"))
    room = cloud.blocks.shape[1] if cloud.blocks.ndim == 3 else 0
    check_arrays((cloud.blocks, (maps, room, COLUMNS), "f"))
    if cloud.counts.min(initial=0) < 0 or cloud.counts.max(initial=0) > room:
        raise ValueError("its maps are longer than what is there of them")
    if cloud.slots.min(initial=0) < 0 or cloud.slots.max(initial=0) >= maps:
        raise ValueError("a particle's map is not there")
    if not np.isfinite(cloud.log_weights.max()) or np.isnan(cloud.log_weights).any():
        raise ValueError("its particles have no weight")
    if not 0 <= state.best < number:
        raise ValueError("its heaviest particle is not there")
    way, rates = state.way, state.rates
    check_arrays((way.reference, (biases,), "f"), (way.covariance, (biases, biases), "f"))
    if (way.belief.n, way.belief.robot) != (3 + biases, 3 + biases):
        raise ValueError("the way since the last frame does not fit the motion model")
    check_arrays(*((each, (RINGS,), "f") for each in (rates.stated, rates.could, rates.were)))
    check_arrays((state.pose, (3,), "f"), (state.spread, (3, 3), "f"))


def _rebuilt(kind: type[FiniteSetSlam], state: _State, detector: Detector | None) -> FiniteSetSlam:
    slam = kind(state.motion, state.sensor, state.config, extent=state.extent, detector=detector)
    cloud, particles, ahead = state.cloud, slam._particles, slam._ahead
    particles.poses, particles.biases, particles.log_weights = cloud.poses, cloud.biases, cloud.log_weights
    particles.slots, particles.blocks, particles.counts = cloud.slots, cloud.blocks, cloud.counts
    ahead.belief, ahead.reference, ahead.covariance = (
        state.way.belief,
        state.way.reference,
        state.way.covariance,
    )
    slam.rng, slam.rates, slam._left = _generator(state.random), state.rates, cloud.left
    slam._pose, slam._spread, slam._foreseen = state.pose, state.spread, cloud.poses
    slam._numbers, slam._count = state.numbers, state.count
    slam._time, slam._moved = float.fromhex(state.time), state.moved
    slam.frames_taken, slam.step_number = state.frames, state.step_number
    slam._best, slam.resampled, slam.recovered = state.best, state.resampled, state.recovered
    return slam
