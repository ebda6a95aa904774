"""The filters' short names, and which combinations make sense."""

from __future__ import annotations

from kalmap.gaussian.linearisers import BuiltIn, CentralDifference, Cubature, Jacobian, Unscented
from kalmap.records import ConfigError, FilterConfig

FILTERS: dict[str, tuple[BuiltIn, str]] = {
    "ekf": (Jacobian(), "reduced"),
    "ukf": (Unscented(), "full"),
    "cdkf": (CentralDifference(), "full"),
    "ckf": (Cubature(), "full"),
    "cr-ukf": (Unscented(), "reduced"),
    "cr-cdkf": (CentralDifference(), "reduced"),
    "cr-ckf": (Cubature(), "reduced"),
}


def resolve_filter(config: FilterConfig) -> tuple[BuiltIn, str]:
    """(lineariser, scope) of a named filter. Raises ConfigError where name and scope contradict each other."""
    if config.name not in FILTERS:
        raise ConfigError(f"filter.name: {config.name!r} is none of {', '.join(FILTERS)}")
    lineariser, scope = FILTERS[config.name]
    if config.scope is None or config.scope == scope:
        return lineariser, scope
    if config.name == "ekf":
        raise ConfigError(
            "filter.scope: a Jacobian draws no points, so the EKF is the same in both scopes: leave 'full' out"
        )
    if config.name.startswith("cr-"):
        raise ConfigError(
            f"filter.scope: {config.name!r} is by name the reduced filter; for the full one take {config.name[3:]!r}"
        )
    return lineariser, config.scope
