"""Nothing that Hydra reads may execute code: what it would call by name is held against what its plugins registered.

Hydra imports and calls whatever a `_target_` names, in a callback, a launcher or a sweeper, and Python's logging
whatever a handler's `()` or `class` names. Such names can stand in YAML files and overrides that somebody else wrote.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from typing import Any
from unittest import mock

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError

from occfusion.errors import ConfigError

OWN = frozenset({"occfusion.cli.multirun.EndTable"})
HANDLERS = frozenset({"logging.StreamHandler", "logging.FileHandler", "logging.NullHandler"})
RESOLVERS = frozenset({"oc.env", "oc.select", "now", "hydra", "python_version"})
"""Of OmegaConf and Hydra: those that give text. Others make groups out of text, which could hold a `_target_`."""
NAMING_CODE = (
    "hydra.job.env_set",
    "hydra.launcher.setup",
    "hydra.launcher.python",
    "hydra.sweeper.custom_search_space",
)
"""Settings of Hydra and its plugins that name functions, shell commands, or where programs are found."""
_INTERPOLATION = re.compile(r"\$\{([^:}$]*)([:}$]|\Z)")


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuses flags that execute what a file holds.

    Raises:
        ConfigError: with the argument.
    """
    for argument in arguments:
        flag = argument.partition("=")[0]  # any beginning of a long flag stands for it
        if len(flag) > 2 and "--experimental-rerun".startswith(flag):
            raise ConfigError(f"{argument}: reads a pickle, which can execute anything; type the overrides")
        if flag in ("-cp", "-cn") or (len(flag) > 9 and "--config-path --config-name".find(flag) >= 0):
            raise ConfigError(
                f"{argument}: what it names could execute anything; use --config-dir and +group=name"
            )
        if "pkg://" in argument:
            raise ConfigError(f"{argument}: importing a package executes it; name a folder")


@contextlib.contextmanager
def guarded_hydra() -> Iterator[None]:
    """Has every configuration that Hydra composes checked before anything in it is called."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra.errors import ConfigCompositionException

    load = ConfigLoaderImpl.load_configuration

    def checked(self: ConfigLoaderImpl, *arguments: Any, **options: Any) -> DictConfig:
        config = load(self, *arguments, **options)
        try:
            check_composed(config)
            for key in ("hydra.run.dir", "hydra.sweep.dir"):
                OmegaConf.select(config, key)
        except (ConfigError, InterpolationKeyError) as error:  # Hydra shows its own without a traceback
            raise ConfigCompositionException(f"ConfigError: {error}") from error
        return config

    with mock.patch.object(ConfigLoaderImpl, "load_configuration", checked):
        yield


@contextlib.contextmanager
def mode_by_flags() -> Iterator[None]:
    """Has Hydra not compose a configuration only to learn whether there are many jobs, which takes half a second."""
    from hydra._internal.hydra import Hydra

    with mock.patch.object(Hydra, "get_mode", return_value=None):
        yield


def check_composed(config: DictConfig) -> None:
    """Refuses a composed configuration that names code which is not known.

    Raises:
        ConfigError: with the setting, and what it names.
    """
    for key, value in _leaves(OmegaConf.to_container(config, resolve=False)):
        problem = _problem(key, str(value)) if value not in (None, {}, []) else None
        if problem is not None:
            raise ConfigError(f"setting {key}={value}: {problem}")


def _problem(key: str, text: str) -> str | None:
    """Returns what is wrong with a setting and what to do, None for nothing."""
    name, is_of_hydra = key.rpartition(".")[2], key.startswith("hydra.")
    if name == "_target_" and not (is_of_hydra and text in OWN | _registered_targets()):
        return "no code is taken from a configuration; leave it out"
    if any(
        end == "$" or (end == ":" and found not in RESOLVERS) for found, end in _INTERPOLATION.findall(text)
    ):
        return f"of resolvers there are {', '.join(sorted(RESOLVERS))}; write the value itself"
    if not is_of_hydra:
        return None
    if key.startswith(NAMING_CODE):
        return "names code, or where programs are found; set that up in the shell instead"
    is_logging = key.startswith(("hydra.job_logging.", "hydra.hydra_logging."))
    if is_logging and (name in ("()", "factory") or "ext://" in text or "cfg://" in text):
        return "names code; leave it out"
    if is_logging and name in ("class", "queue", "listener") and text not in HANDLERS:
        return f"of handlers there are {', '.join(sorted(HANDLERS))}"
    return None


def _registered_targets() -> frozenset[str]:
    """Returns what the installed launchers and sweepers are called, as their plugins registered them."""
    from hydra.core.config_store import ConfigStore
    from hydra.core.plugins import Plugins
    from hydra.plugins.launcher import Launcher
    from hydra.plugins.sweeper import Sweeper

    # importing them fills the store
    classes = [one for kind in (Launcher, Sweeper) for one in Plugins.instance().discover(kind)]
    store, found = ConfigStore.instance(), {f"{one.__module__}.{one.__qualname__}" for one in classes}
    for group in ("hydra/launcher", "hydra/sweeper"):
        for name in store.list(group):
            content = OmegaConf.to_container(store.load(f"{group}/{name}").node)
            found |= {str(value) for key, value in _leaves(content) if key.rpartition(".")[2] == "_target_"}
    return frozenset(found)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yields dotted keys and values of nested settings; an empty group is a value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, one in inner:
        yield from _leaves(one, f"{key}.{name}" if key else str(name))
    if not inner:
        yield key, value
