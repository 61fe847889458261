"""Settings of a program: a validated model filled from command line, environment and a TOML file."""

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails
from pydantic_settings import EnvSettingsSource

from rig_protocol.errors import ConfigurationError


class Settings(BaseModel):
    """Base of every settings model: unknown keys are refused, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


S = TypeVar("S", bound=Settings)


def load_settings(
    model: type[S], file: Path | None, env_prefix: str, overrides: Mapping[str, Any] | None = None
) -> S:
    """The effective settings; a later source yields to an earlier one, key by key.

    Sources: `overrides` (nested, None = not given), environment variables `PREFIX_KEY` and
    `PREFIX_TABLE__KEY`, the TOML file, the model's defaults.
    ConfigurationError names the key, its file and the nearest known name.
    """
    origin = "settings" if file is None else str(file)
    merged = _merge(_merge(_read_toml(file), _environment(model, env_prefix)), _without_none(overrides or {}))
    try:
        return model.model_validate(merged)
    except ValidationError as error:
        lines = [_explain(model, details) for details in error.errors()]
        raise ConfigurationError(f"{origin}: " + "; ".join(lines)) from error


def _read_toml(file: Path | None) -> dict[str, Any]:
    if file is None:
        return {}
    try:
        return tomllib.loads(file.read_text())
    except OSError as error:
        raise ConfigurationError(f"{file} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{file} is not valid TOML: {error}") from error


def _environment(model: type[Settings], prefix: str) -> dict[str, Any]:
    known = [f"{prefix}{name}".upper() for name in model.model_fields]
    for variable in os.environ:
        if variable.startswith(prefix) and variable.split("__")[0] not in known:
            raise ConfigurationError(
                f"environment variable {variable} names no setting{_nearest(variable, known)}"
            )
    source = EnvSettingsSource(
        model,  # type: ignore[arg-type]  # the source reads fields only; our models are no BaseSettings
        env_prefix=prefix,
        env_nested_delimiter="__",
        case_sensitive=False,
    )
    return source()


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        both_tables = isinstance(below, Mapping) and isinstance(value, Mapping)
        merged[key] = _merge(below, value) if both_tables else value  # type: ignore[arg-type]
    return merged


def _without_none(values: Mapping[str, Any]) -> dict[str, Any]:
    cleaned = {
        key: _without_none(value) if isinstance(value, Mapping) else value for key, value in values.items()
    }
    return {key: value for key, value in cleaned.items() if value is not None and value != {}}


def _explain(model: type[BaseModel], details: ErrorDetails) -> str:
    where = ".".join(str(part) for part in details["loc"])
    if details["type"] == "extra_forbidden":
        return f"unknown key `{where}`{_nearest_key(model, details['loc'])}"
    return f"`{where}`: {details['msg']} (got {details['input']!r})"


def _nearest_key(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """The same key of another table, with its path; else a key of the same table that is spelt alike."""
    *table, key = [str(part) for part in location if isinstance(part, str)]
    paths = _key_paths(model)
    for path in paths:
        if path[-1] == key:
            return f"; did you mean `{'.'.join(path)}`?"
    return _nearest(key, [path[-1] for path in paths if list(path[:-1]) == table])


def _key_paths(model: type[BaseModel], table: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    paths: list[tuple[str, ...]] = []
    for name, info in model.model_fields.items():
        paths.append((*table, name))
        for candidate in (info.annotation, *getattr(info.annotation, "__args__", ())):
            if isinstance(candidate, type) and issubclass(candidate, BaseModel):
                paths += _key_paths(candidate, (*table, name))
    return paths


def _nearest(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean `{near[0]}`?" if near else ""
