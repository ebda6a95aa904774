"""What a laser scanner reports in every frame: trunks and movers as thick as they are, one behind the other."""

from __future__ import annotations

import numpy as np

from kalmap.geometry.angles import wrap
from kalmap.records import Scan, SightingTruth
from kalmap.simulate.raycast import Scanner, cast_hits, noisy
from kalmap.simulate.world import World


def scans_of(
    world: World,
    scanner: Scanner,
    looks: np.ndarray,
    times: np.ndarray,
    tracks: np.ndarray,
    rng: np.random.Generator,
) -> tuple[list[Scan], SightingTruth]:
    """The sweep of every frame, and which trunks a beam hits in it.

    looks (F, 3): the sensor's poses at `times` (F,) s. tracks (F, K, 2): where the movers are, who are circles of
    `mover_radius`. A sweep is taken in one instant, by those of the scanner's beams that lie inside the world's
    field of view. Every return has its own noise, `sigma_beam`.

    The truth lists range and bearing of a trunk's centre, without noise, for each scan in which at least one beam
    ends on that trunk, by time and then by id; ids are the rows of `world.landmarks`.
    """
    bearings = scanner.bearings
    bearings = bearings[np.abs(bearings) <= np.radians(world.field_of_view_deg) / 2.0 + 1e-9]
    trunks = np.column_stack([world.landmarks, np.asarray(world.radii)])
    radii = np.full((*tracks.shape[:2], 1), world.mover_radius)
    moving = np.concatenate([tracks, radii], axis=-1)
    exact, targets = cast_hits(looks, trunks, bearings, world.max_range, moving=moving)
    ranges = np.abs(noisy(exact, world.sigma_beam, rng))
    scans = [
        Scan(float(time), sweep, bearings, record=number + 1)
        for number, (time, sweep) in enumerate(zip(times, ranges, strict=True))
    ]
    return scans, _truth(looks, times, trunks, targets)


def _truth(looks: np.ndarray, times: np.ndarray, trunks: np.ndarray, targets: np.ndarray) -> SightingTruth:
    hit_frames, beams = np.nonzero((targets >= 0) & (targets < len(trunks)))
    pairs = np.unique(hit_frames * len(trunks) + targets[hit_frames, beams])
    frame, trunk = np.divmod(pairs, max(1, len(trunks)))
    dx, dy = (trunks[trunk, :2] - looks[frame, :2]).T
    values = np.column_stack([np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - looks[frame, 2])])
    return SightingTruth(times=times[frame], values=values, ids=trunk.astype(np.int64))
