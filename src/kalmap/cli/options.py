"""Options that several verbs share, and what they amount to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from kalmap.cli.settings import Settings, merge, parse_pairs, read_config

FILTER_NAMES = ("ekf", "ukf", "cdkf", "ckf", "cr-ukf", "cr-cdkf", "cr-ckf")

SET_METHODS = ("rb-phd", "srckf-phd", "mh-fastslam", "pmb", "pmbm")
CONTOUR_METHODS = ("slasem", "dc-slasem")
METHOD_NAMES = (*FILTER_NAMES, *SET_METHODS, *CONTOUR_METHODS)
# settings of the one family that the other has no use for
_FILTERS_ONLY = ("filter_name", "scope", "coordinates", "use", "association", "management", "divide")
_SETS_ONLY = ("particles", "proposal", "weighting")
_LANDMARKS_ONLY = ("use", "association", "management", "detector", "divide")

_TOPICS = (
    click.option("--scan-topic", help="Of a ROS bag with several lasers."),
    click.option("--odometry-topic", help="Of a ROS bag: odometry, or /tf for the transform from odom."),
)

_SHARED = (
    click.option("--scope", type=click.Choice(["full", "reduced"]), help="What the lineariser is handed."),
    click.option("--coordinates", type=click.Choice(["invariant", "additive"]), help="Error coordinates."),
    click.option(
        "--use", type=click.Choice(["joint", "sequential"]), help="How a frame's sightings are used."
    ),
    click.option(
        "--association",
        type=click.Choice(["known", "nearest", "likelihood", "jcbb", "mda", "djnn", "pmb"]),
        help="By the log's ids, or by place in one of six ways.",
    ),
    click.option(
        "--management",
        type=click.Choice(["keep", "trial", "counter", "existence"]),
        help="Which new landmarks are believed.",
    ),
    click.option(
        "--detector", type=click.Choice(["reflectors", "trees"]), help="What is looked for in scans."
    ),
    click.option(
        "--particles",
        type=click.IntRange(min=1),
        help="Of a method of random finite sets; default 10.",
    ),
    click.option(
        "--proposal",
        type=click.Choice(["sightings", "motion"]),
        help="What its particles are drawn from.",
    ),
    click.option(
        "--weighting",
        type=click.Choice(["empty", "single-feature", "single-cluster", "multi-feature"]),
        help="rb-phd, srckf-phd: what of the map weighs a particle.",
    ),
    click.option(
        "--divide",
        is_flag=True,
        help="Divide and conquer: local maps, joined in a forest; a Kalman filter's step does not grow with the map.",
    ),
    click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML or JSON settings."),
    click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="One setting; may be repeated."),
    click.option("--seed", type=click.IntRange(min=0), help="Seed of a simulated world."),
    click.option("--robot", metavar="K|all", help="Which robot of a log of several."),
    click.option("--variant", help="Which form of a log that has several (detections, ascii, scans, ...)."),
    *_TOPICS,
    click.option(
        "--clutter",
        type=click.FloatRange(min=0),
        help="Add so many false sightings to every frame, on average (one log alone).",
    ),
    click.option("--tolerant", is_flag=True, help="Skip bad records, count and list them."),
    click.option("--quiet", "-q", is_flag=True, help="No progress, no summary."),
)


def shared_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of every verb that runs a filter."""
    for option in reversed(_SHARED):
        command = option(command)
    return command


def topic_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say what is read of a ROS bag."""
    for option in reversed(_TOPICS):
        command = option(command)
    return command


def topics(given: dict[str, Any]) -> tuple[str | None, str | None]:
    """The topics of the scans and of the odometry, None where they are not named."""
    return given["scan_topic"], given["odometry_topic"]


def gather(given: dict[str, Any], several: bool = False) -> tuple[Settings, dict[str, Any]]:
    """Settings from file, pairs and flags, later ones on top; and apart from them those of the world.

    several: they are for methods of both families. Else options that the method has no use for are refused.
    """
    settings = read_config(given["config_file"]) if given["config_file"] else {}
    settings = merge(settings, parse_pairs(given["pairs"]))
    flags: Settings = {}
    filter_name = None if several else _chosen(given, settings, flags)
    for key in ("scope", "coordinates", "use"):
        if given[key] is not None:
            flags.setdefault("filter", {})[key] = given[key]
    named = filter_name or (settings.get("filter") or {}).get("name")
    if given["scope"] == "full" and named is None:
        flags["filter"]["name"] = "cdkf"  # the default filter's full form
    if filter_name is not None:
        flags.setdefault("filter", {})["name"] = filter_name
    for key, table, field in (
        ("association", "association", "method"),
        ("management", "association", "management"),
        ("detector", "perception", "detector"),
        ("particles", "finite_set", "particles"),
        ("proposal", "finite_set", "proposal"),
        ("weighting", "finite_set", "weighting"),
    ):
        if given[key] is not None:
            flags.setdefault(table, {})[field] = given[key]
    if given["seed"] is not None:
        flags["seed"] = given["seed"]
    if given["divide"]:
        flags["divide"] = {"on": True}
    if given["tolerant"]:
        flags["tolerant"] = True
    settings = merge(settings, flags)
    world = settings.pop("world", {})
    if not isinstance(world, dict):
        raise click.UsageError("world: expected settings such as world.laps=1")
    return settings, world


def _chosen(given: dict[str, Any], settings: Settings, flags: Settings) -> str | None:
    """The filter that --method or --filter names; a method of sets goes into `flags`.

    Raises UsageError where the options of one family are given for a method of the other.
    """
    method, filter_name = given.get("method"), given.get("filter_name")
    if method in FILTER_NAMES and filter_name not in (None, method):
        raise click.UsageError(f"--method {method} and --filter {filter_name} contradict each other")
    filter_name = method if method in FILTER_NAMES else filter_name
    table = settings.get("finite_set")
    sets = table.get("method") if isinstance(table, dict) else None
    if method in CONTOUR_METHODS:
        flags.setdefault("contour", {})["method"] = method
        _refuse(given, _LANDMARKS_ONLY, method)
    if method in SET_METHODS:  # pmbm begins with a filter
        sets = flags.setdefault("finite_set", {})["method"] = method
    elif filter_name is not None:
        sets = flags.setdefault("finite_set", {})["method"] = None
    if sets is None:
        refuse_for_sets_only(given, filter_name or "a Kalman filter")
        return filter_name
    _refuse(
        given, _FILTERS_ONLY if sets != "pmbm" else ("association", "proposal", "weighting", "divide"), sets
    )
    return filter_name


def _refuse(given: dict[str, Any], keys: tuple[str, ...], method: str) -> None:
    """Raise UsageError if an option is given that the method has no use for."""
    for key in keys:
        if given.get(key) not in (None, False):
            option = "filter" if key == "filter_name" else key
            value = "" if given[key] is True else f" {given[key]}"
            raise click.UsageError(f"--{option}{value} means nothing to {method}")


def refuse_for_sets_only(given: dict[str, Any], method: str) -> None:
    """Raise UsageError if an option is given that only methods of random finite sets have a use for."""
    for key in _SETS_ONLY:
        if given.get(key) is not None:
            known = ", ".join(SET_METHODS)
            raise click.UsageError(f"--{key} {given[key]} means nothing to {method}; it is for {known}")


def parse_robot(text: str | None) -> int | None:
    """--robot as a number; `all` is the caller's business."""
    if text is None:
        return None
    if not text.isascii() or not text.isdigit():
        only = "; `kalmap run` alone takes all" if text == "all" else " or all"
        raise click.UsageError(f"--robot {text}: expected a number{only}")
    return int(text)
