"""Methods by name: "cr-cdkf:additive", "ekf:jcbb", "srckf-phd:motion:single-feature", "dc-slasem:ekf"."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, get_args

import msgspec

from kalmap.records import AssociationConfig, ConfigError, FilterConfig, FiniteSetConfig, RunConfig
from kalmap.records.config import ContourMethod
from kalmap.slam import ASSOCIATIONS, FILTERS, SET_METHODS, WEIGHED_METHODS, check_method, resolve_filter
from kalmap.study.cases import Method

_FILTER_SUFFIXES = {
    "additive": ("coordinates", "additive"),
    "invariant": ("coordinates", "invariant"),
    "joint": ("use", "joint"),
    "sequential": ("use", "sequential"),
    **{name: ("association", name) for name in ASSOCIATIONS},
}
_CONTOUR_METHODS: tuple[str, ...] = get_args(ContourMethod)
_CONTOUR_SUFFIXES = {
    **{name: ("coordinates", name) for name in ("additive", "invariant")},
    **{name: ("name", name) for name in FILTERS},
}
_SET_SUFFIXES = {
    **{name: ("proposal", name) for name in ("motion", "sightings")},
    **{name: ("weighting", name) for name in ("empty", "single-feature", "single-cluster", "multi-feature")},
}


def parse_method(
    text: str,
    base: FilterConfig | None = None,
    association: AssociationConfig | None = None,
    finite_set: FiniteSetConfig | None = None,
) -> Method:
    """The method of "ekf", "cr-cdkf:additive", "ekf:invariant:sequential", "cr-cdkf:djnn", "srckf-phd:motion", or
    "dc-slasem:ekf".

    association: where its settings come from if the text names a method of association. base: where coordinates
    and use come from if the text does not say; the scope is the name's. finite_set: likewise for a method of random
    finite sets. The name is the text in lower case, as a label. Raises `ConfigError` for unknown names, listing
    those that exist.
    """
    label = text.strip().lower()
    name, *suffixes = label.split(":")
    if name in SET_METHODS:
        said = _said(text, suffixes, _SET_SUFFIXES if name != "pmbm" else {})
        if name not in WEIGHED_METHODS:
            said.setdefault("weighting", None)
        sets = msgspec.structs.replace(finite_set or FiniteSetConfig(), method=name, **said)
        check_method(RunConfig(finite_set=sets))
        return Method(label, base or FilterConfig(), finite_set=sets)
    if name in _CONTOUR_METHODS:
        said = _said(text, suffixes, _CONTOUR_SUFFIXES)
        return Method(
            label,
            msgspec.structs.replace(
                base or FilterConfig(), **({"scope": None} if "name" in said else {}), **said
            ),
            contour=name,  # type: ignore[arg-type]
        )
    if name not in FILTERS:
        known = ", ".join((*FILTERS, *SET_METHODS, *_CONTOUR_METHODS))
        raise ConfigError(f"method {text!r}: unknown filter {name!r}; known are {known}")
    said = _said(text, suffixes, _FILTER_SUFFIXES)
    own = said.pop("association", None)
    if own is not None:
        association = msgspec.structs.replace(association or AssociationConfig(), method=own)
    parsed = msgspec.structs.replace(base or FilterConfig(), name=name, scope=None, **said)
    resolve_filter(parsed)
    return Method(label, parsed, association if own is not None else None)


def _said(text: str, suffixes: list[str], known: Mapping[str, tuple[str, str]]) -> dict[str, Any]:
    """Field -> value of the suffixes."""
    said: dict[str, Any] = {}
    for suffix in suffixes:
        if suffix not in known:
            names = ", ".join(f":{name}" for name in known)
            raise ConfigError(f"method {text!r}: unknown suffix {suffix!r}; known are {names}")
        field, value = known[suffix]
        if said.setdefault(field, value) != value:
            raise ConfigError(f"method {text!r}: {said[field]} and {value} contradict each other")
    return said


def parse_methods(
    texts: Iterable[str],
    base: FilterConfig | None = None,
    association: AssociationConfig | None = None,
    finite_set: FiniteSetConfig | None = None,
) -> list[Method]:
    """Several of them, each at most once."""
    methods = [parse_method(text, base, association, finite_set) for text in texts]
    names = [method.name for method in methods]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"method {name!r} is asked for twice")
    return methods
