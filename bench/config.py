"""Hydra configuration to a checked :class:`~bench.grid.Experiment`."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench import registry
from bench.errors import STATUSES, UserError, unknown
from bench.grid import AXES, Choice, Execution, Experiment

SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
LISTS = tuple(AXES.values())
SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
BYTES = {"k": 2.0**10, "m": 2.0**20, "g": 2.0**30}


def config_dir() -> Path:
    """Where ``config.yaml`` and the experiments lie: beside the package in a checkout, inside it when installed."""
    package = Path(__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def experiments() -> list[str]:
    """Names of the experiments that come with the package."""
    return sorted(path.stem for path in (config_dir() / "experiment").glob("*.yaml"))


def load(overrides: Sequence[str]) -> Experiment:
    """The experiment that Hydra composes from overrides; raises :class:`UserError` for anything wrong in them."""
    from hydra import compose, initialize_config_dir
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    parser = OverridesParser.create()
    prepared = []
    for override in overrides:
        prepared.append(_prepared(override))
        try:
            parser.parse_override(prepared[-1])
        except HydraException:
            raise UserError(
                f"'{override}' cannot be read: write key=value with lists as [a,b] and texts in quotes"
            ) from None
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            config = compose("config", overrides=prepared)
        plain = OmegaConf.to_container(config, resolve=False, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(str(error).strip().splitlines()[0]) from None
    assert isinstance(plain, dict)
    return experiment({str(k): v for k, v in plain.items()})


@registry.remember
def _known_keys() -> frozenset[str]:
    import yaml

    return frozenset(yaml.safe_load((config_dir() / "config.yaml").read_text())) - {"defaults"}


def _prepared(override: str) -> str:
    """The override as Hydra wants it, with experiments and plugin parameters reachable without ``+``."""
    if "=" not in override:
        raise UserError(f"'{override}' is not an override: write key=value (commands come first: see --help)")
    if "${" in override:
        raise UserError(f"'{override}': interpolations are not resolved here, give the value itself")
    key, _, value = override.partition("=")
    bare = key.lstrip("+~")
    head = bare.partition(".")[0]
    if head == "experiment":
        if "," in value:
            raise UserError(
                f"'{override}': one command runs one experiment, with its own sweep; give a command to each"
            )
        if value not in experiments():
            raise unknown("experiment", value, experiments())
        return f"+experiment={value}"
    if head.partition("/")[0] == "hydra" or key.startswith("~"):
        raise UserError(f"'{override}': Hydra's own settings cannot be changed here")
    if head not in _known_keys():
        raise unknown("setting", bare, {*_known_keys(), "experiment"})
    if head in LISTS:
        return f"{bare}={_quoted(value)}"
    if head in AXES or head == "sweep":
        return f"++{bare}={value}"
    if bare != head and head != "reference":
        raise UserError(f"'{bare}' is not a setting: '{head}' has no parts")
    return f"{bare}={value}"


def notes(overrides: Sequence[str]) -> list[str]:
    """What wins where both an experiment's file and the command line give a sweep."""
    import yaml

    split = [(key.lstrip("+"), value) for key, _, value in (word.partition("=") for word in overrides)]
    chosen = [value for key, value in split if key == "experiment"]
    given: list[str] = []
    for key, value in split:
        head, _, axis = key.partition(".")
        if head == "sweep":
            given.extend([axis] if axis else (yaml.safe_load(value.replace(":", ": ")) or {}))
    if not chosen or not given:
        return []
    own = yaml.safe_load((config_dir() / "experiment" / f"{chosen[-1]}.yaml").read_text()).get("sweep") or {}
    wins = [f"{axis} of the command line replaces that of {chosen[-1]}" for axis in given if axis in own]
    adds = [f"{axis} of the command line is multiplied with it" for axis in given if axis not in own]
    kept = [f"{axis} of {chosen[-1]} stays" for axis in own if axis not in given]
    return [f"sweep: {'; '.join(wins + kept + adds)}"] if own else []


def _quoted(value: str) -> str:
    """A list of identity strings with each one quoted, since a shell eats the quotes that Hydra needs around brackets."""
    inner = value[1:-1] if value.startswith("[") and value.endswith("]") else value
    items, depth = [""], 0
    for letter in inner:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            items.append("")
        else:
            items[-1] += letter
    if depth != 0:
        return value
    names = [item.strip().strip("'\"") for item in items]
    return "[" + ",".join(f"'{name}'" for name in names if name) + "]"


def experiment(config: Mapping[str, Any]) -> Experiment:
    """A resolved configuration checked against the registry."""
    extra = set(config) - _known_keys()
    if extra:
        raise unknown("setting", sorted(extra)[0], _known_keys())
    name = str(config["name"])
    if not SAFE_NAME.fullmatch(name) or ".." in name:
        raise UserError(f"name={name!r} must be letters, digits, '.', '_' and '-', since it names a folder")
    choices = {kind: [_choice(kind, item) for item in _listed(config, kind)] for kind in LISTS}
    for group, kind in AXES.items():
        for plugin, values in _table(config, group).items():
            entry = registry.find(kind, plugin)
            if not isinstance(values, Mapping):
                raise UserError(f"{group}.{plugin}={values!r} must name a parameter: {group}.{plugin}.parameter=value")
            if entry.plugin is not None:
                registry.build(entry.plugin, values)
    counts = {key: registry.coerce(int, config[key], key) for key in ("samples", "repeats", "seed")}
    settings = _table(config, "reference")
    for key in settings:
        if key not in ("samples", "tolerance"):
            raise unknown("setting of reference", key, ("samples", "tolerance"))
    budget = registry.coerce(int, settings["samples"], "reference.samples")
    tolerance = registry.coerce(float, settings["tolerance"], "reference.tolerance")
    if budget < 256 or not tolerance > 0:
        raise UserError("reference.samples must be at least 256 and reference.tolerance greater than 0")
    timing = config["timing"]
    return Experiment(
        name=name,
        timing=None if timing is None else registry.coerce(bool, timing, "timing"),
        execution=_execution(config),
        choices=choices,
        values={group: _table(config, group) for group in AXES},
        sweep=_table(config, "sweep"),
        results_dir=Path(str(config["results_dir"])).expanduser(),
        question=str(config["question"] or ""),
        study=str(config["study"]),
        marks=_table(config, "marks"),
        compile_time=registry.coerce(bool, config["compile_time"], "compile_time"),
        reference_samples=budget,
        reference_tolerance=tolerance,
        compile_cache=_compile_cache(config["compile_cache"]),
        **counts,
    )


def _compile_cache(value: Any) -> Path | None:
    if value is None:
        return None
    if str(value) != "default":
        return Path(str(value)).expanduser().absolute()
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "diffsim-bench" / "jax"


def _execution(config: Mapping[str, Any]) -> Execution:
    workers = config["workers"]
    if workers is not None and registry.coerce(int, workers, "workers") < 0:
        raise UserError(f"workers={workers} must be at least 0, or null for the number of cores")
    retry = config["retry"] if isinstance(config["retry"], list) else [config["retry"]]
    return Execution(
        workers=None if workers is None else registry.coerce(int, workers, "workers"),
        timeout=_amount("timeout", config["timeout"], SECONDS, "600, 10m"),
        memory=_whole(_amount("memory", config["memory"], BYTES, "4g, 500m")),
        stop=_one_of("on_error", config["on_error"], ("continue", "stop")) == "stop",
        versions=_one_of("versions", config["versions"], ("ignore", "warn", "rerun")),
        retry=tuple(_one_of("retry", status, STATUSES) for status in retry if status is not None),
    )


def _one_of(key: str, value: Any, allowed: Sequence[str]) -> str:
    if value not in allowed:
        raise unknown(f"value for {key}:", value, allowed)
    return str(value)


def _amount(key: str, value: Any, units: Mapping[str, float], example: str) -> float | None:
    """A positive number with one of the units, or None for no limit."""
    if value is None:
        return None
    text = str(value).strip().lower()
    number, unit = (text[:-1], text[-1:]) if text[-1:] in units else (text, "")
    try:
        amount = float(number) * units.get(unit, 1.0)
    except ValueError:
        amount = math.nan
    if isinstance(value, bool) or not 0 < amount < math.inf:
        raise UserError(f"{key}={value!r} must be an amount such as {example}, greater than 0, or null for no limit")
    return amount


def _whole(amount: float | None) -> int | None:
    return None if amount is None else math.ceil(amount)


def _table(config: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = config[key] if config[key] is not None else {}
    if not isinstance(value, Mapping):
        raise UserError(f"{key}={value!r} must be a table of settings: {key}.name=value")
    return {str(k): v for k, v in value.items()}


def _listed(config: Mapping[str, Any], kind: str) -> list[Any]:
    value = config[kind]
    listed = value if isinstance(value, list) else [value]
    if not listed or value is None:
        raise UserError(f"{kind} is empty: give at least one of {', '.join(sorted(registry.entries()[kind]))}")
    return listed


def _choice(kind: str, text: Any) -> Choice:
    name, values = registry.parse_identity(text)
    entry = registry.find(kind, name)
    if entry.plugin is not None:
        registry.build(entry.plugin, values)
    return Choice(entry, tuple(sorted(values.items())))
