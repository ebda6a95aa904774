"""Options that several verbs share, and what they amount to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from kalmap.cli.settings import Settings, merge, parse_pairs, read_config

FILTER_NAMES = ("ekf", "ukf", "cdkf", "ckf", "cr-ukf", "cr-cdkf", "cr-ckf")

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
    click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML or JSON settings."),
    click.option("--set", "pairs", multiple=True, metavar="KEY=VALUE", help="One setting; may be repeated."),
    click.option("--seed", type=click.IntRange(min=0), help="Seed of a simulated world."),
    click.option("--robot", metavar="K|all", help="Which robot of a log of several."),
    click.option("--variant", help="Which form of a log that has several (detections, ascii, scans, ...)."),
    click.option("--tolerant", is_flag=True, help="Skip bad records, count and list them."),
    click.option("--quiet", "-q", is_flag=True, help="No progress, no summary."),
)


def shared_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of every verb that runs a filter."""
    for option in reversed(_SHARED):
        command = option(command)
    return command


def gather(given: dict[str, Any]) -> tuple[Settings, dict[str, Any]]:
    """Settings from file, pairs and flags, later ones on top; and apart from them those of the world."""
    settings = read_config(given["config_file"]) if given["config_file"] else {}
    settings = merge(settings, parse_pairs(given["pairs"]))
    flags: Settings = {}
    for key in ("scope", "coordinates", "use"):
        if given[key] is not None:
            flags.setdefault("filter", {})[key] = given[key]
    named = given.get("filter_name") or (settings.get("filter") or {}).get("name")
    if given["scope"] == "full" and named is None:
        flags["filter"]["name"] = "cdkf"  # the default filter's full form
    if given.get("filter_name") is not None:
        flags.setdefault("filter", {})["name"] = given["filter_name"]
    for key, table, field in (
        ("association", "association", "method"),
        ("management", "association", "management"),
        ("detector", "perception", "detector"),
    ):
        if given[key] is not None:
            flags.setdefault(table, {})[field] = given[key]
    if given["seed"] is not None:
        flags["seed"] = given["seed"]
    if given["tolerant"]:
        flags["tolerant"] = True
    settings = merge(settings, flags)
    world = settings.pop("world", {})
    if not isinstance(world, dict):
        raise click.UsageError("world: expected settings such as world.laps=1")
    return settings, world


def parse_robot(text: str | None) -> int | None:
    """--robot as a number; `all` is the caller's business."""
    if text is None:
        return None
    if not text.isascii() or not text.isdigit():
        only = "; `kalmap run` alone takes all" if text == "all" else " or all"
        raise click.UsageError(f"--robot {text}: expected a number{only}")
    return int(text)
