"""A frame through a run of particles: propose, update the map, weigh."""

import math

import numpy as np

from kalmap.kernels.bernoulli import bernoulli_update
from kalmap.kernels.compiled import compiled
from kalmap.kernels.phd import phd_update
from kalmap.kernels.proposal import lower_rows, moved, propose, world_root

PHD, BERNOULLI = 0, 1
BY_MOTION, BY_SIGHTINGS = 0, 1


@compiled
def place(
    setup,
    rules,
    profile,
    beams,
    noise,
    block,
    count,
    pose,
    root,
    z,
    proposal,
    spread_by,
    normal,
    out,
    left,
):
    """Where one particle goes, `out` (3,); returns ln of what that weighs. Arguments as `propose`."""
    if proposal == BY_SIGHTINGS:
        return propose(
            setup, rules, profile, beams, pose, root, noise, block, count, z, normal, spread_by, out, left
        )
    moved(pose, root, spread_by * normal, out)
    left[:] = 0.0
    return 0.0


@compiled
def with_kept(root, left, delta, heading, out):
    """Root of what is not known of a particle's pose at the end of a way, in the body's frame: (3, 3), lower.

    root: of the way alone. left: of the pose at its beginning, in the world's axes. delta (3,): the way, in the body's
    frame of its beginning. heading: rad, at its end.
    """
    columns = np.empty((3, 6))
    columns[:, :3] = root
    turn = heading - delta[2]
    dx = math.cos(turn) * delta[0] - math.sin(turn) * delta[1]
    dy = math.sin(turn) * delta[0] + math.cos(turn) * delta[1]
    cosine, sine = math.cos(heading), math.sin(heading)
    for k in range(3):
        x, y = left[0, k] - dy * left[2, k], left[1, k] + dx * left[2, k]
        columns[0, 3 + k] = cosine * x + sine * y
        columns[1, 3 + k] = cosine * y - sine * x
        columns[2, 3 + k] = left[2, k]
    lower_rows(columns, out)


@compiled
def set_out(
    setup,
    rules,
    profile,
    beams,
    noise,
    block,
    count,
    pose,
    root,
    delta,
    z,
    proposal,
    known_pose,
    spread_by,
    normal,
    left,
    way,
    within,
):
    """What one particle's frame begins with: where it goes. Returns ln of what that weighs.

    pose (3,): where odometry puts it, on return where it is. left (3, 3): root of the covariance that is left of the
    pose, before and after. way (3, 3): on return the root of all that was not known of the pose; within (3, 3): of what
    the update of the map takes for unknown. The rest as `step_particles`.
    """
    kept = math.sqrt(max(1.0 - spread_by * spread_by, 0.0))
    way[:] = root
    if kept > 0.0:
        with_kept(root, kept * left, delta, pose[2], way)
    where = np.empty(3)
    log_factor = place(
        setup,
        rules,
        profile,
        beams,
        noise,
        block,
        count,
        pose,
        way,
        z,
        proposal,
        spread_by,
        normal,
        where,
        left,
    )
    pose[:] = where
    within[:] = kept * left
    if not known_pose:
        world_root(pose[2], root, within)
    return log_factor


@compiled
def step_particles(
    setup,
    rules,
    profile,
    beams,
    noise,
    blocks,
    counts,
    slots,
    poses,
    root,
    delta,
    z,
    number,
    kind,
    proposal,
    known_pose,
    spread_by,
    normals,
    first,
    last,
    left,
    ways,
    log_factors,
    explained,
    tallies,
):
    """Carry particles first to last through a frame, in place.

    blocks (S, capacity, COLUMNS) and counts (S,): the maps; slots (N,): whose is whose, each its own by now. poses
    (N, 3): where odometry puts them, on return where they are. root (3, 3): of the motion since the last frame, in
    the body's frame at its end. kind: PHD or BERNOULLI. proposal: BY_MOTION or BY_SIGHTINGS. known_pose: False
    keeps the motion's covariance in the update of the map, as SRCKF-PHD-SLAM does. normals (N, 3): standard normal
    draws, multiplied with spread_by. left (N, 3, 3): root of the covariance that is left of each pose. log_factors
    (N,), explained (N, M), tallies (N, 2, RINGS): out.
    """
    within = np.empty((3, 3))
    for p in range(first, last):
        block, count = blocks[slots[p]], counts[slots[p]]
        log_factor = set_out(
            setup,
            rules,
            profile,
            beams,
            noise,
            block,
            count,
            poses[p],
            root,
            delta,
            z,
            proposal,
            known_pose,
            spread_by,
            normals[p],
            left[p],
            ways[p],
            within,
        )
        what = setup, rules, profile, beams, poses[p], within, noise, block, count, z, number
        if kind == PHD:
            count, factor = phd_update(*what, explained[p], tallies[p])
        else:
            count, factor = bernoulli_update(*what, explained[p], tallies[p])
        counts[slots[p]] = count
        log_factors[p] = log_factor + factor
