"""Which runs the reproduction of Sun et al. 2010 is made of, and what is kept of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from kalmap.data.files import write_atomically
from kalmap.geometry.angles import wrap
from kalmap.geometry.se2 import compose, inverse
from kalmap.geometry.segments import segment_distances
from kalmap.records import ConfigError, FilterConfig, KalmapError, Reference
from kalmap.simulate import FloorWorld, simulate_floor, world_by_name
from kalmap.study.cases import Case, Method
from kalmap.study.slasem_drive import Driven, drive_floor
from kalmap.study.store import Store

FLOORS = ("floor-115", "floor-170")
PLAIN, DIVIDED = "slasem", "dc-slasem"
FILTERS = {
    "ekf": FilterConfig(name="ekf", coordinates="additive"),
    "cr-cdkf": FilterConfig(name="cr-cdkf", coordinates="additive"),
    "invariant": FilterConfig(name="ekf", coordinates="invariant"),
}
"""As published; and what kalmap has beside it."""

REVISIT, ON_THE_WAY = (
    0.5,
    15.0,
)  # m: two scans so near each other, so far apart on the way, are a place seen again
CURVE_POINTS = 2_000
_WARM_SCANS, _WARM_SEED = 160, 9_001
_JOIN = 1e-3  # s of a scan from which on a map was closed or joined there


class FloorRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a study keeps of a run.

    metrics: see `judged`. times: s of the scans; live_seconds, join_seconds, samples: for each of them. true, path:
    (x, y) m, thinned out; local, maps: the samples of every local map, and of what they became; walls: segments m.
    error: why the filter gave up, then all else is empty.
    """

    world: str
    method: str
    seed: int
    metrics: dict[str, float] = {}
    times: list[float] = []
    live_seconds: list[float] = []
    join_seconds: list[float] = []
    samples: list[int] = []
    true: list[list[float]] = []
    path: list[list[float]] = []
    local: list[list[list[float]]] = []
    maps: list[list[list[float]]] = []
    walls: list[list[float]] = []
    error: str | None = None


class Plan(msgspec.Struct, frozen=True):
    """The floors, the filters by name and all cases. altered: not the study's floors."""

    worlds: list[FloorWorld]
    filters: list[str]
    cases: list[Case]
    altered: bool = False


def method_name(filter_name: str, divided: bool) -> str:
    """What a method is called: the paper's own by the paper's names."""
    name = DIVIDED if divided else PLAIN
    return name if filter_name == "ekf" else f"{name}, {filter_name}"


def make_plan(
    runs: int, filters: Sequence[str] = ("ekf",), worlds: Sequence[FloorWorld] | None = None
) -> Plan:
    """Both ways on every floor with seeds 1 to `runs`. Raises `ConfigError` for what makes no sense."""
    if runs < 1:
        raise ConfigError(f"runs must be 1 or more, got {runs}")
    for name in filters:
        if name not in FILTERS:
            raise ConfigError(f"methods: {name!r} is none of {', '.join(FILTERS)}")
    if len(set(filters)) < len(filters) or not filters:
        raise ConfigError("methods: each is named once, and one at least")
    floors = [world_by_name(name) for name in FLOORS] if worlds is None else list(worlds)
    chosen = [each for each in floors if isinstance(each, FloorWorld)]
    cases = [
        Case(world, Method(method_name(name, divided), filter=FILTERS[name]), seed)
        for world in chosen
        for seed in range(1, runs + 1)
        for name in filters
        for divided in (False, True)
    ]
    return Plan(chosen, list(filters), cases, worlds is not None)


def run_floor(case: Case) -> FloorRecord:
    """Simulate, drive and judge. A filter that gives up makes a record of that."""
    assert isinstance(case.world, FloorWorld)
    log = simulate_floor(case.world, case.seed)
    names = (case.world.name, case.method.name, case.seed)
    try:
        driven = drive_floor(log, case.config(), case.method.name.startswith(DIVIDED))
    except (KalmapError, ArithmeticError) as problem:
        return FloorRecord(*names, error=str(problem))
    reference = log.references[0]
    thin = max(1, len(driven.times) // CURVE_POINTS)
    return FloorRecord(
        *names,
        metrics=judged(driven, reference),
        times=driven.times.tolist(),
        live_seconds=driven.live_seconds.tolist(),
        join_seconds=driven.join_seconds.tolist(),
        samples=driven.samples.astype(int).tolist(),
        true=np.round(reference.positions[::thin], 3).tolist(),
        path=np.round(driven.final[::thin, :2], 3).tolist(),
        local=[np.round(each, 3).tolist() for each in driven.local],
        maps=[np.round(each, 3).tolist() for each in driven.maps],
        walls=np.round(reference.walls, 3).tolist(),
    )


def warm_up(world: FloorWorld) -> None:
    """Load or compile what a run needs, so that no run is timed while it does: some metres, closed early, joined."""
    log = simulate_floor(world, _WARM_SEED)
    config = log.defaults
    early = msgspec.structs.replace(config.contour, close_samples=40)
    for name in FILTERS:
        chosen = msgspec.structs.replace(config, filter=FILTERS[name], contour=early)
        drive_floor(log, chosen, True, _WARM_SCANS)


def judged(driven: Driven, reference: Reference) -> dict[str, float]:
    """Errors, times and sizes of a run.

    position_rmse_m, heading_rmse_deg: of the pose at every scan as it was known then; final_...: as the map has it in
    the end. revisit_worst_m: of all pairs of scans at one place but `ON_THE_WAY` m apart, how far the map has them
    wrong to each other, at most; revisits: how many pairs. wall_m: mean distance of samples to true walls.
    """
    true = np.column_stack([reference.positions, reference.headings])[: len(driven.times)]
    live, join = driven.live_seconds, driven.join_seconds
    samples = np.concatenate(driven.maps)
    revisits = _revisit_errors(true, driven.final)
    return {
        **_errors("", driven.online, true),
        **_errors("final_", driven.final, true),
        "total_s": float(live.sum() + join.sum()),
        "live_s": float(live.sum()),
        "join_s": float(join.sum()),
        "live_ms_median": 1e3 * float(np.median(live)),
        "live_ms_p99": 1e3 * float(np.percentile(live, 99)),
        "live_ms_max": 1e3 * float(live.max()),
        "amortised_ms_max": 1e3 * float(amortised(live, join).max()),
        "local_maps": float(len(driven.local)),
        "maps": float(len(driven.maps)),
        "refusals": float(driven.refusals),
        "samples": float(len(samples)),
        "wall_m": float(segment_distances(samples, reference.walls).mean()),
        "revisits": float(len(revisits)),
        "revisit_worst_m": float(revisits.max(initial=0.0)),
    }


def amortised(live_seconds: np.ndarray, join_seconds: np.ndarray) -> np.ndarray:
    """(F,) s a scan, with the time of every join spread over the scans up to the next one, as in figure 5 (c).

    The last joins have nothing after them and are spread over what came before.
    """
    is_join = join_seconds > _JOIN
    spread = np.where(is_join, live_seconds, live_seconds + join_seconds)
    at = np.flatnonzero(is_join).tolist()
    if not at:
        return np.asarray(spread)
    for start, end in zip(at, [*at[1:], len(spread)], strict=True):
        begin = start + 1 if end - start > 1 else (at[-2] if len(at) > 1 else 0)
        spread[begin:end] += join_seconds[start] / max(1, end - begin)
    return np.asarray(spread)


def _errors(prefix: str, poses: np.ndarray, true: np.ndarray) -> dict[str, float]:
    position = np.hypot(*(poses[:, :2] - true[:, :2]).T)
    heading = np.degrees(wrap(poses[:, 2] - true[:, 2]))
    return {
        f"{prefix}position_rmse_m": float(np.sqrt(np.mean(position**2))),
        f"{prefix}heading_rmse_deg": float(np.sqrt(np.mean(heading**2))),
    }


def _revisit_errors(true: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(R,) m: of scans at one place, how far the later one is wrong as seen from the earlier one."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true[:, :2], axis=0).T))])
    rows = np.flatnonzero(np.diff(np.floor(way / 0.2), prepend=-1.0) > 0)  # one for every 20 cm
    near = np.hypot(*(true[rows, None, :2] - true[None, rows, :2]).transpose(2, 0, 1)) < REVISIT
    again = near & (way[rows][None] - way[rows][:, None] > ON_THE_WAY)
    first, second = (rows[each] for each in np.nonzero(again))
    exact = compose(inverse(true[first]), true[second])
    said = compose(inverse(poses[first]), poses[second])
    return np.asarray(np.hypot(*(said - exact)[:, :2].T))


class FloorStore:
    """The records that were already made, so that a study goes on where it was stopped; see `Store`."""

    def __init__(self, folder: Path) -> None:
        self._store = Store(folder)

    def read(self, case: Case) -> FloorRecord | None:
        """None if there is none, or a damaged one."""
        try:
            return msgspec.json.decode(self._store.path(case).read_bytes(), type=FloorRecord)
        except (OSError, msgspec.MsgspecError):
            return None

    def write(self, case: Case, record: FloorRecord) -> None:
        """Keep a record."""
        write_atomically(self._store.path(case), msgspec.json.encode(record) + b"\n")
