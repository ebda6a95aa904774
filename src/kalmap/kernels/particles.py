"""A frame through a run of particles: propose, update the map, weigh."""

import numpy as np
from numba import njit

from kalmap.kernels.bernoulli import bernoulli_update
from kalmap.kernels.phd import phd_update
from kalmap.kernels.proposal import moved, propose, world_root

PHD, BERNOULLI = 0, 1
BY_MOTION, BY_SIGHTINGS = 0, 1


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
    pose, within = np.empty(3), np.zeros((3, 3))
    for p in range(first, last):
        block, count = blocks[slots[p]], counts[slots[p]]
        log_factor = place(
            setup,
            rules,
            profile,
            beams,
            noise,
            block,
            count,
            poses[p],
            root,
            z,
            proposal,
            spread_by,
            normals[p],
            pose,
            left[p],
        )
        poses[p] = pose
        if not known_pose:
            world_root(pose[2], root, within)
        if kind == PHD:
            count, factor = phd_update(
                setup,
                rules,
                profile,
                beams,
                pose,
                within,
                noise,
                block,
                count,
                z,
                number,
                explained[p],
                tallies[p],
            )
        else:
            count, factor = bernoulli_update(
                setup,
                rules,
                profile,
                beams,
                pose,
                within,
                noise,
                block,
                count,
                z,
                number,
                explained[p],
                tallies[p],
            )
        counts[slots[p]] = count
        log_factors[p] = log_factor + factor
