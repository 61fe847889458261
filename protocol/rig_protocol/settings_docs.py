"""What a settings model says about itself: a commented TOML file, the effective values, a Markdown table.

Everything comes from the model: names, defaults, types, bounds, examples and the docstrings below the fields.
"""

import math
import textwrap
import types
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rig_protocol.errors import ConfigurationError
from rig_protocol.settings import Settings

_WIDTH = 100
_PLAIN_NAMES = {str: "text", int: "integer", float: "number", bool: "true or false", Path: "path"}


def commented_toml(model: type[Settings]) -> str:
    """A TOML file that changes nothing: every key is there, explained, commented out, with its default.

    Removing the `#` before a key gives a valid file. A key that is unset by default shows its example.
    """
    return _document(_commented_lines(model, _defaults(model), ""))


def write_commented_toml(model: type[Settings], path: Path, force: bool) -> None:
    """What `init` does; ConfigurationError when the file cannot be written, or exists and `force` is off."""
    try:
        with path.open("w" if force else "x") as file:
            file.write(commented_toml(model))
    except FileExistsError as error:
        raise ConfigurationError(f"{path} exists: --force overwrites it, --path writes elsewhere") from error
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from error


def effective_toml(settings: Settings) -> str:
    """The values of `settings` as TOML that loads into an equal object; keys that are None are left out."""
    return _document(_value_lines(settings, ""))


def markdown_table(model: type[Settings]) -> str:
    """One table of every key (dotted; `[]` marks a list of tables): type, default, meaning."""
    lines = ["| Key | Type | Default | Meaning |", "|---|---|---|---|"]
    for key, field, default in _flat_fields(model, _defaults(model), ""):
        meaning = " ".join((field.description or "").split())
        cells = (f"`{key}`", _type_text(field), _default_text(field, default), meaning)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


# ---- walking a model: the keys of a table come before its sub-tables, as TOML wants it


def _keys(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    return ((name, field) for name, field in model.model_fields.items() if _table_of(field) is None)


def _tables(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo, type[BaseModel], bool]]:
    """(name, field, model of the table, is it a list of tables)."""
    for name, field in model.model_fields.items():
        found = _table_of(field)
        if found is not None:
            yield name, field, *found


def _table_of(field: FieldInfo) -> tuple[type[BaseModel], bool] | None:
    """The model behind `Table`, `Table | None`, `tuple[Table, ...]`, `list[Table]`; does it repeat?"""
    for candidate in (field.annotation, *get_args(field.annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate, get_origin(field.annotation) in (list, tuple)
    return None


def _defaults(model: type[BaseModel], instance: Any = None) -> dict[str, Any]:
    """Default by key, None where there is none; a table's own default instance wins over its model's."""
    if isinstance(instance, model):
        return dict(instance)
    return {
        name: None if field.is_required() else field.get_default(call_default_factory=True)
        for name, field in model.model_fields.items()
    }


def _flat_fields(
    model: type[BaseModel], defaults: Mapping[str, Any], prefix: str
) -> Iterator[tuple[str, FieldInfo, Any]]:
    for name, field in _keys(model):
        yield prefix + name, field, defaults[name]
    for name, _, table, repeats in _tables(model):
        path = f"{prefix}{name}{'[]' if repeats else ''}."
        yield from _flat_fields(table, _defaults(table, defaults[name]), path)


# ---- commented TOML


def _commented_lines(model: type[BaseModel], defaults: Mapping[str, Any], prefix: str) -> Iterator[str]:
    if not prefix:
        yield from (*_comment(model.__doc__ or ""), "")
    own = _defaults(model)
    for name, field in _keys(model):
        yield from _comment(field.description or "")
        shown = defaults[name]
        if shown is None:
            state = "Required" if field.is_required() else "Unset by default"
            yield f"# {state} ({_type_text(field)}). For example:"
            shown = _example(field)
        # An empty table means its model's defaults, so a default that its parent changed stays active.
        mark = "#" if defaults[name] == own[name] else ""
        yield from (f"{mark}{name} = {_toml_value(shown)}", "")
    for name, field, table, repeats in _tables(model):
        path = f"{prefix}{name}"
        header = f"[[{path}]]" if repeats else f"[{path}]"
        yield from _comment(field.description or table.__doc__ or "")
        # The header alone would add an entry to a list, or switch an optional table on.
        yield f"#{header}" if repeats or defaults[name] is None else header
        yield from _commented_lines(table, _defaults(table, defaults[name]), f"{path}.")


def _comment(text: str) -> Iterator[str]:
    for paragraph in textwrap.dedent(text).strip().splitlines():
        yield from ("# " + line for line in textwrap.wrap(paragraph, _WIDTH) or [""])


# ---- effective values


def _value_lines(settings: BaseModel, prefix: str) -> Iterator[str]:
    model = type(settings)
    for name, _ in _keys(model):
        value = getattr(settings, name)
        if value is not None:
            yield f"{name} = {_toml_value(value)}"
    tables = [(name, repeats) for name, _, _, repeats in _tables(model)]
    yield from (f"{name} = []" for name, repeats in tables if repeats and not getattr(settings, name))
    for name, repeats in tables:
        value, path = getattr(settings, name), f"{prefix}{name}"
        for entry in value if repeats else () if value is None else (value,):
            yield from ("", f"[[{path}]]" if repeats else f"[{path}]")
            yield from _value_lines(entry, f"{path}.")


def _toml_value(value: Any) -> str:
    if isinstance(value, Enum):
        return _toml_value(value.value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else f"{value:f}"  # TOML says inf and nan, as Python does
    if isinstance(value, str | Path):
        return _toml_string(str(value))
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml_string(str(k))} = {_toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple | set | frozenset):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    raise TypeError(f"TOML has no {type(value).__name__}")


def _toml_string(text: str) -> str:
    return '"' + "".join(map(_toml_character, text)) + '"'


def _toml_character(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    return character if character.isprintable() else f"\\U{ord(character):08X}"


# ---- words


def _example(field: FieldInfo) -> Any:
    """The field's first example, else an empty value of its type."""
    if field.examples:
        return field.examples[0]
    kinds = (field.annotation, *get_args(field.annotation))
    return next((kind() for kind in kinds if kind in (bool, int, float)), "")


def _default_text(field: FieldInfo, default: Any) -> str:
    if field.is_required():
        return "required"
    return "unset" if default is None else f"`{_toml_value(default)}`"


def _type_text(field: FieldInfo) -> str:
    bounds = [_bound_text(item) for item in field.metadata]
    return ", ".join([_annotation_text(field.annotation), *(text for text in bounds if text)])


def _annotation_text(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _annotation_text(arguments[0])
    if origin is Literal:
        return " | ".join(_toml_value(value) for value in arguments)
    if origin in (Union, types.UnionType):
        return " | ".join(_annotation_text(one) for one in arguments if one is not types.NoneType)
    if origin in (list, tuple, set, frozenset):
        return f"list of {_annotation_text(arguments[0])}" if arguments else "list"
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " | ".join(_toml_value(member) for member in annotation)
    return _PLAIN_NAMES.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _bound_text(constraint: Any) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    return ", ".join(
        f"{sign} {getattr(constraint, name)}" for name, sign in signs.items() if hasattr(constraint, name)
    )


def _document(lines: Iterator[str]) -> str:
    return "\n".join(lines).strip() + "\n"
