"""Turns Hydra configuration into a validated :class:`~bench.experiment.experiment.Experiment`."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

from bench.errors import STATUSES, UserError, local_path, printable, unknown
from bench.experiment.cell import DESCENDED
from bench.experiment.experiment import Budget, Choice, Execution, Experiment
from bench.experiment.grid import COUNTS, check_axes, coerce_finite, parameter_name, refuse_too_many, share_of, swept
from bench.experiment.overrides import (
    LISTS_AS,
    MAPPINGS,
    Override,
    check_file,
    merge,
    names_of,
    parse,
    quoted,
    with_ranges,
)
from bench.experiment.study import Study
from bench.host import guard
from bench.host.identity import parse_identity
from bench.host.parameters import Parameter, build, check, coerce, parameters, remember, singular
from bench.model import Decision, MechanicalScene, Plugin, registry
from bench.simulator.clock import parse_duration


def config_dir() -> Path:
    """Return the folder of ``config.yaml`` and the experiments: beside the package in a checkout, else inside it."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def experiments(config_dirs: Sequence[Path] = ()) -> list[str]:
    """Return the sorted names of the package's experiments and of the user's experiments in ``config_dirs``.

    A file ``experiment/NAME/SIZE.yaml`` is another size of an experiment: its name is ``NAME/SIZE``.
    """
    folders = [folder / "experiment" for folder in (config_dir(), *config_dirs)]
    return sorted(
        {path.relative_to(folder).with_suffix("").as_posix() for folder in folders for path in folder.rglob("*.yaml")}
    )


def load(
    words: Sequence[str], config_dirs: Sequence[Path] = (), settings: Mapping[str, Any] | None = None
) -> Experiment:
    """Return the experiment that Hydra composes from words of the command line; raises :class:`UserError` if one is invalid or not read.

    ``config_dirs`` are folders with the user's own experiments, as ``experiment/NAME.yaml``. Plugin folders may have some
    too. ``settings`` are further settings as values of Python.
    """
    folders = _as_list((settings or {}).get("plugins"))
    if not all(isinstance(folder, str | Path) and str(folder) for folder in folders):
        raise UserError(f"plugins={folders} must be folders; the current one is plugins=.")
    for key, _, value in (word.lstrip("+").partition("=") for word in words):
        if key == "plugins":
            if not names_of(value) and not value.startswith("["):
                raise UserError(f"plugins={value} names no folder; the current one is plugins=.")
            folders += names_of(value)
    for folder in folders:
        registry.add_folder(Path(folder))
    config_dirs = [*config_dirs, *(folder for folder in registry.folders() if (folder / "experiment").is_dir())]
    overrides = [_parsed(word, config_dirs) for word in words]
    overrides += [_of_python(key, value) for key, value in (settings or {}).items()]
    loaded = _composed(overrides, config_dirs)
    _refuse_unread(loaded, overrides)
    given = {keys[0] for keys, _ in overrides}
    if "compares" in given:
        return loaded
    # what a command line chooses is drawn, whatever the file compares
    return replace(loaded, compares={name: values for name, values in loaded.compares.items() if name not in given})


def _of_python(key: str, value: Any) -> Override:
    """Return a setting given in Python; arrays and other sequences become lists, paths strings."""
    _check_key(key)
    if isinstance(value, str) and key in _name_lists():
        return [key], names_of(value)
    return key.split("."), json.loads(as_json(key, value))


def as_json(key: str, value: Any) -> str:
    """Return a setting given in Python as JSON; raises :class:`UserError` for a table whose keys are no strings."""
    try:
        return json.dumps(
            value,
            separators=(",", ":"),
            default=lambda one: (
                one.tolist() if hasattr(one, "tolist") else list(one) if isinstance(one, range) else str(one)
            ),
        )
    except TypeError as error:
        raise UserError(f"{key}={value}: {error}") from None


def _composed(overrides: Sequence[Override], config_dirs: Sequence[Path]) -> Experiment:
    for folder in config_dirs:
        if not (folder / "experiment").is_dir():
            raise UserError(
                f"'{folder}' has no experiments: put them into its folder experiment, as experiment/NAME.yaml"
            )
    named = [name for keys, value in overrides if keys == ["experiment"] for name in names_of(value)]
    if len(named) > 1:
        commands = " && ".join(f"python -m bench +experiment={name}" for name in named)
        raise UserError(f"one command runs one experiment with its sweep: {commands}")
    if named and named[0] not in (known := experiments(config_dirs)):
        raise unknown("experiment", named[0], known, "--help")
    of_files = _composed_files(next(iter(named), ""), tuple(config_dirs), _stamps(config_dirs))
    settings = deepcopy(of_files)
    for keys, value in overrides:
        if keys not in (["experiment"], ["answer"]):
            merge(settings, keys, value)
    if any(value != of_files.get(key) for key, value in settings.items() if key not in NEUTRAL):
        settings["answer"] = ""
    also = [coerce(str, name, "also") for name in _as_list(settings["also"])]
    return _joined(from_settings(settings), also, overrides, config_dirs)


def _stamps(config_dirs: Sequence[Path]) -> tuple[tuple[Path, int, int], ...]:
    """Return path, time of change and size of every experiment file and of ``config.yaml``."""
    files = [path for folder in (*config_dirs, config_dir()) for path in (folder / "experiment").rglob("*.yaml")]
    files.append(config_dir() / "config.yaml")
    return tuple((path, path.stat().st_mtime_ns, path.stat().st_size) for path in files if path.exists())


@lru_cache(maxsize=128)
def _composed_files(name: str, config_dirs: tuple[Path, ...], stamps: object) -> dict[str, Any]:
    """Return the settings that Hydra composes from ``config.yaml`` and, if any, an experiment's files, with its own answer only.

    ``stamps`` tell contents of the files apart.
    """
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    words, own = [], {}
    if name:
        files = (folder / "experiment" / f"{name}.yaml" for folder in (*config_dirs, config_dir()))
        words, own = [f"+experiment={name}"], check_file(next(file for file in files if file.exists()))
    if config_dirs:
        search_path = ",".join(f"'file://{folder.expanduser().absolute()}'" for folder in config_dirs)
        words.insert(0, f"hydra.searchpath=[{search_path}]")
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            config = compose("config", overrides=words)
        plain = OmegaConf.to_container(config, resolve=False, throw_on_missing=True)
    except Exception as error:  # Hydra raises errors of many types, and only Hydra's code runs here
        lines = [str(part).strip().partition("\n")[0] for part in (error, error.__cause__) if part is not None]
        raise UserError(printable(": ".join(lines))[:1000]) from None
    assert isinstance(plain, dict)
    return {str(k): v for k, v in plain.items()} | {"answer": own.get("answer")}


NEUTRAL = (
    "experiment",
    "name",
    "results_dir",
    "answer",
    "compares",
    "formats",
    "chart_columns",
    "compile_cache",
    "plugins",
    "workers",
    "timeout",
    "memory",
    "on_error",
    "ladder",
    "versions",
    "retry",
    "shard",
)
"""Settings that decide no result: where others differ from those of its file, the answer of an experiment does not hold."""


def _joined(
    main: Experiment, names: Sequence[Any], overrides: Sequence[Override], config_dirs: Sequence[Path]
) -> Experiment:
    """Return an experiment with those that join it, which have the same settings of the command line."""
    common = [one for one in overrides if one[0] not in (["experiment"], ["also"])]
    also = tuple(_composed([(["experiment"], name), *common, (["also"], [])], config_dirs) for name in names)
    for name, other in zip(names, also, strict=True):
        if other.study != main.study:
            raise UserError(f"also: {name} has another study or other settings of it than {main.name}")
    return replace(main, also=also)


def _known_keys() -> frozenset[str]:
    kinds = [kind for kind in registry.kinds() if kind != "studies"]
    return _settings() | {*kinds, *map(singular, kinds)}


@remember
def _settings() -> frozenset[str]:
    import yaml

    return frozenset(yaml.safe_load((config_dir() / "config.yaml").read_text())) - {"defaults"}


def _name_lists() -> tuple[str, ...]:
    """Return the settings whose values are lists of names, which may have brackets: Hydra would need quotes around them."""
    return (*registry.kinds(), "path", "plugins")


def _parsed(word: str, config_dirs: Sequence[Path]) -> Override:
    """Return the keys and the value of a word of the command line."""
    if "=" not in word:
        if word in experiments(config_dirs):
            raise UserError(f"'{word}' is an experiment: write +experiment={word}")
        if word.startswith("-"):
            raise unknown("option", word, ("--config-dir", "--help", "--quiet", "--version"))
        raise unknown("experiment", word, experiments(config_dirs), "--help; settings are key=value")
    if "${" in word:
        raise UserError(f"'{word}': interpolations are not supported, give the value itself")
    key, _, value = word.partition("=")
    bare = key.lstrip("+~")
    if bare == "experiment":
        if not names_of(value):
            raise UserError(f"'{word}' names no experiment; python -m bench --help lists them")
        return [bare], value
    if key.startswith("~") or bare.partition(".")[0].partition("/")[0] == "hydra":
        raise UserError(f"'{word}': Hydra's own settings cannot be changed")
    _check_key(bare)
    if bare == "study" or bare in _name_lists():
        if value.count("[") != value.count("]"):
            raise UserError(f"'{word[:200]}' cannot be read: {LISTS_AS}")
        return [bare], value.strip("'\"") if bare == "study" else names_of(value)
    return parse(word, f"{bare}={quoted(with_ranges(bare, value))}")


def _check_key(key: str) -> None:
    """Raise :class:`UserError` for a key that is no setting."""
    head = key.partition(".")[0]
    if head not in _known_keys():
        raise unknown("setting", key, {*_known_keys(), "experiment"}, "--help")
    tables = {*map(singular, registry.kinds()), *MAPPINGS}
    if key != head and (head not in tables or (head == "reference" and key.count(".") > 1)):
        whole = key.rpartition(".")[0]
        raise UserError(f"'{key}' is not a setting: '{whole}' has no settings of its own")


def _refuse_unread(experiment: Experiment, overrides: Sequence[Override]) -> None:
    """Raise :class:`UserError` for the name of an override that nothing in the experiment reads."""
    every = (experiment, *experiment.also)
    kinds = {kind: singular(kind) for kind in registry.kinds() if kind != "studies"}
    used = {kind: axis for kind, axis in kinds.items() if axis in experiment.choices}
    choices = [(axis, choice.entry) for e in every for axis, some in e.choices.items() for choice in some]
    names = {*_settings() - {*kinds, *kinds.values()}, "experiment", *used, *used.values()}
    names |= {f"{axis}.{entry.name}" for axis, entry in choices}
    plugins = _in_use([entry.plugin for _, entry in choices if entry.plugin])
    axes = set(swept(experiment.whole_sweep))
    for (head, *more), value in overrides:
        tables = more[:1] or (value if isinstance(value, dict) else ())
        for name in [f"{head}.{table}" for table in tables] if head in kinds.values() else [head]:
            if name not in names:
                raise unknown("setting of this experiment", name, names, "--help")
        rest = ".".join(more)
        if head == "sweep" and rest in axes:
            check_axes([rest], plugins)
        marked = {part for axis in axes for part in (axis, parameter_name(axis))}
        if head == "marks" and (unread := experiment.marks.keys() - marked):
            raise unknown("mark", min(unread), marked)
        marked |= {"backends", "contacts", "estimators"}
        if head == "compares" and (unread := experiment.compares.keys() - marked):
            raise unknown("part of compares", min(unread), marked)


def _in_use(plugins: Sequence[type[Plugin]]) -> list[type[Plugin]]:
    """Return the chosen plugins without contact laws and integrators that no chosen scene uses."""
    mechanical = [plugin for plugin in plugins if issubclass(plugin, MechanicalScene)]
    unused = {"contacts"} if not any(plugin.n_contacts != 0 for plugin in mechanical) else set()
    unused |= set() if mechanical else {"integrators"}
    return [plugin for plugin in plugins if plugin.kind not in unused]


def from_settings(config: Mapping[str, Any]) -> Experiment:
    """Return the experiment of a composed configuration; raises :class:`UserError` if a setting is invalid."""
    extra = set(config) - _known_keys()
    if extra:
        raise unknown("setting", sorted(extra)[0], _known_keys(), "--help")
    for folder in _as_list(config["plugins"]):
        registry.add_folder(Path(str(folder)))
    study = _study(config["study"])
    axes = {axis: registry.kind_of(axis) for axis in study.axes}
    choices = {
        axis: [_choice(kind, item) for item in _at_least_one(config, kind, study)] for axis, kind in axes.items()
    }
    if config["reference"] is None:
        raise UserError(
            "reference=null: the study decides whether there is one; reference.samples=... limits its samples"
        )
    timing, sweep = config["timing"], _mapping(config, "sweep")
    # as axes, these settings reach every estimator
    sweep |= {name: [config[name]] for name in ("draws", "mirrored") if config[name] is not None}
    refuse_too_many(sweep)
    return Experiment(
        name=_name(config),
        study=study,
        timing=study.timed if timing is None else coerce(bool, timing, "timing"),
        execution=_execution(config),
        choices=choices,
        values={axis: _values(config, axis, kind) for axis, kind in axes.items()},
        sweep=sweep,
        decision=_decision(config),
        descent=share_of(config["descent"]),
        path=_path(config["path"]),
        results_dir=_folder(config["results_dir"]),
        question=_text(config, "question"),
        answer=_text(config, "answer"),
        marks=_mapping(config, "marks"),
        compares=_compares(config),
        formats=tuple(_one_of("formats", item, ("png", "svg", "pdf")) for item in _as_list(config["formats"])),
        chart_columns=int(_one_of("chart_columns", str(config["chart_columns"]), ("1", "2"))),
        reference=cast(Budget, build(Budget, _mapping(config, "reference", parameters(Budget)))),
        compile_cache=_compile_cache(config["compile_cache"]),
        plugins=registry.folders(),
        **{key: _count(config, key) for key in COUNTS},
    )


def _compares(config: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return what charts compare; names of plugins are identity strings as in the rows."""
    given = {name: _as_list(values) for name, values in _mapping(config, "compares").items()}
    kinds = registry.kinds()
    return {name: [str(_choice(name, v)) if name in kinds else v for v in values] for name, values in given.items()}


def _text(config: Mapping[str, Any], key: str) -> str:
    if isinstance(config[key], list | dict):
        raise UserError(f"{key}={printable(config[key])[:100]} must be a string")
    return str(config[key] or "")


def _name(config: Mapping[str, Any]) -> str:
    name = "" if config["name"] is None else str(config["name"])
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name) or ".." in name:
        raise UserError(
            f"name={name[:200]!r} must be at most 100 letters, digits, '.', '_' and '-', since it names a folder"
        )
    if name in ("claims", "references", "standard", "trace"):
        raise UserError(f"name={name} is reserved for a folder of results_dir that is not an experiment")
    return name


def _values(config: Mapping[str, Any], axis: str, kind: str) -> dict[str, Any]:
    """Return the parameters set for the plugins of an axis, by plugin; raises :class:`UserError` if one is invalid."""
    values = _mapping(config, axis)
    for plugin, given in values.items():
        entry = registry.find(kind, plugin)
        if not isinstance(given, Mapping):
            raise UserError(f"{axis}.{plugin}={given!r} names no parameter: write {axis}.{plugin}.parameter=value")
        if entry.plugin is not None:
            build(entry.plugin, given)
    return values


def _count(config: Mapping[str, Any], key: str) -> Any:
    if isinstance(config[key], list):
        raise UserError(
            f"{key} is one number, and {config[key]} are several: write sweep.{key}=[...] to sweep over them"
        )
    return coerce(int, config[key], key)


def _study(text: Any) -> Study:
    if not isinstance(text, str) or text.startswith("["):
        raise UserError(
            f"study={printable(text)[:100]} must be one name: write study=NAME or study=NAME[parameter=value]"
        )
    name, values = parse_identity(text)
    study = build(registry.usable("studies", name), values)
    if not isinstance(study, Study):
        raise UserError(f"study '{name}' does not derive from bench.plugin.Study")
    return study


def _folder(value: Any) -> Path:
    if not isinstance(value, str | Path) or not str(value).strip():
        raise UserError(f"results_dir={value!r} must be a folder")
    return local_path("results_dir", value)


def _decision(config: Mapping[str, Any]) -> Decision:
    names = [coerce(str, name, "theta") for name in _as_list(config["theta"])]
    at = config["theta0"]
    return Decision(tuple(names), None if at is None else coerce_finite(at, "theta0"))


def _path(given: Any) -> dict[str, Choice]:
    """Return what descents are of, by axis: contact law, integrator, and a backend if there is a third item."""
    items = _as_list(given)
    if len(items) not in (2, 3):
        raise UserError(
            f"path={items} must be a contact law, an integrator and, if wanted, a backend: path=[LAW,INTEGRATOR,BACKEND]"
        )
    given = {axis: item for axis, item in zip(DESCENDED, items, strict=False) if item != "none"}
    return {axis: _choice(registry.kind_of(axis), item) for axis, item in given.items()}


def _as_list(value: Any) -> list[Any]:
    return [] if value is None else list(value) if isinstance(value, list | tuple) else [value]


def _compile_cache(value: Any) -> Path | None:
    if value is None:
        return None
    if str(value) != "default":
        path = local_path("compile_cache", value).absolute()
        if path.exists() and not path.is_dir():
            raise UserError(f"compile_cache={value} is not a folder")
        return path
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "diffsim-bench" / "jax"


def _execution(config: Mapping[str, Any]) -> Execution:
    timeout = config["timeout"]
    return Execution(
        workers=check(Parameter("workers", int | None, None, low=0), config["workers"], "workers"),
        timeout=None if timeout is None else parse_duration(timeout, "timeout"),
        memory=_bytes(config["memory"]),
        stop=_one_of("on_error", config["on_error"], ("continue", "stop")) == "stop",
        ladder=coerce(bool, config["ladder"], "ladder"),
        versions=_one_of("versions", config["versions"], ("ignore", "warn", "rerun")),
        retry=tuple(_one_of("retry", status, STATUSES) for status in _as_list(config["retry"]) if status is not None),
        shard=_shard(config),
    )


def _shard(config: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the number and the count in ``shard=3/64``, or None."""
    if config["shard"] is None:
        return None
    text = str(config["shard"])
    found = re.fullmatch(r"(\d+)/(\d+)", text, re.ASCII)
    number, count = map(int, found.groups()) if found else (0, 0)
    if not 1 <= number <= count:
        raise UserError(f"shard={printable(text)} must be NUMBER/COUNT, such as 3/64, with NUMBER from 1 to COUNT")
    if config["ladder"]:
        raise UserError("ladder=true needs the rows of all scenes, and shard= runs some: leave one of them out")
    return number, count


def _one_of(key: str, value: Any, allowed: Sequence[str]) -> str:
    if value not in allowed:
        raise unknown(f"value for {key}:", value, allowed)
    return str(value)


def _bytes(value: Any) -> int | None:
    """Return an amount of memory such as ``4g`` in bytes, greater than 0, or None for no limit."""
    if value is None:
        return None
    text, amount = str(value).strip().lower(), math.nan
    unit = {"k": 2.0**10, "m": 2.0**20, "g": 2.0**30}.get(text[-1:])
    with suppress(ValueError):
        amount = float(text[:-1] if unit else text) * (unit or 1.0)
    if not 0 < amount < math.inf:
        raise UserError(f"memory={value!r} must be an amount such as 4g, 500m, greater than 0, or null for no limit")
    return math.ceil(amount)


def _mapping(config: Mapping[str, Any], key: str, allowed: Collection[str] = ()) -> dict[str, Any]:
    value = {} if config.get(key) is None else config[key]
    if not isinstance(value, Mapping):
        raise UserError(f"{key}={value!r} must be a table: write {key}.name=value")
    for name in value:
        if allowed and name not in allowed:
            raise unknown(f"setting of {key}", name, allowed)
    return {str(k): v for k, v in value.items()}


def _at_least_one(config: Mapping[str, Any], kind: str, study: Study) -> list[Any]:
    items = _as_list(study.default_plugins.get(kind) if config.get(kind) is None else config[kind])
    if not items:
        raise UserError(f"{kind} is empty: give at least one: python -m bench list {kind}")
    return items


def _choice(kind: str, text: Any) -> Choice:
    name, values = parse_identity(text)
    entry = registry.find(kind, name)
    if entry.plugin is not None:
        # a plugin that changes the working folder would break relative paths
        with guard.capture_output(f"{singular(kind)} {name}"), guard.protect_process():
            build(entry.plugin, values)
    return Choice(entry, tuple(sorted(values.items())))
