"""From defaults, a configuration file, `--set` and flags to one resolved configuration."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import msgspec

from kalmap.records import ConfigError, LogError, RunConfig
from kalmap.records.config import DetectorName

Settings = dict[str, Any]


def read_config(path: Path) -> Settings:
    """A TOML or JSON file as a dictionary.

    Raises LogError, naming file and field, if it cannot be read or holds what is no setting.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        loaded = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise LogError("no such file", file=path) from None
    except OSError as problem:
        raise LogError(
            f"cannot be read: {(problem.strerror or str(problem)).lower()}", file=path
        ) from problem
    except (ValueError, RecursionError) as problem:  # not UTF-8, not JSON, not TOML, or a number of no end
        raise LogError(f"is no configuration that can be read: {problem}", file=path) from problem
    if not isinstance(loaded, dict):
        raise LogError("expected a table of settings", file=path)
    try:
        resolve(RunConfig(), {key: value for key, value in loaded.items() if key != "world"})
    except ConfigError as problem:
        what, _, place = str(problem).removeprefix("configuration: ").partition(" - at ")
        field = place.strip("`").removeprefix("$").removeprefix(".") or None
        raise LogError(what, file=path, field=field) from problem
    return loaded


_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def parse_pairs(pairs: tuple[str, ...]) -> Settings:
    """`key.sub=value` texts as a nested dictionary; values are JSON, numbers as people write them (`.5`), or text."""
    settings: Settings = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {pair}: expected key=value, for instance motion.sigma_speed=0.3")
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = float(text) if _NUMBER.fullmatch(text.strip()) else text
        *path, last = key.strip().split(".")
        place = settings
        for step in path:
            place = place.setdefault(step, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {pair}: {step} has a value already")
        place[last] = value
    return settings


def merge(base: Settings, over: Settings) -> Settings:
    """`over` on top of `base`, table by table."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def resolve(defaults: RunConfig, settings: Settings) -> RunConfig:
    """The defaults with settings on top. Raises ConfigError naming an unknown key or a wrong value."""
    base = msgspec.to_builtins(defaults)
    own, asked = defaults.perception.detector, settings.get("perception")
    if isinstance(asked, dict) and asked.get("detector", own) != own:
        base["perception"] = {}  # the settings of another detector mean nothing to this one
    try:
        resolved = msgspec.convert(merge(base, settings), RunConfig, strict=True)
    except msgspec.ValidationError as problem:
        raise ConfigError(f"configuration: {problem}") from problem
    _check_finite(msgspec.to_builtins(resolved), "$")
    return resolved


def check_detector(defaults: RunConfig, settings: Settings, config: RunConfig) -> None:
    """Raise ConfigError where landmarks are to be mapped from a log of raw scans, and nobody said what they are.

    defaults: the log's own. settings: as they were given. config: as they were resolved.
    """
    asked = settings.get("perception")
    named = isinstance(asked, dict) and "detector" in asked
    if defaults.contour.method is not None and config.contour.method is None and not named:
        known = " or ".join(get_args(DetectorName))
        raise ConfigError(
            f"the log holds raw scans and no landmarks: say what to look for in them (--detector {known}), or map "
            "contours (--method dc-slasem or slasem; --filter takes its filter)"
        )


def _check_finite(settings: Settings, place: str) -> None:
    """Raise ConfigError for a setting that is NaN or infinite, which JSON and TOML can say."""
    for key, value in settings.items():
        if isinstance(value, dict):
            _check_finite(value, f"{place}.{key}")
        elif isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"configuration: Expected a finite number, got {value} - at `{place}.{key}`")
