"""Files of users: TOML files that follow a schema, and parameters of stages changed by name.

Messages name problems in the terms of the file.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from aomgen.errors import ConfigError, LimitExceededError, MalformedFileError, MissingFileError, suggest

Schema = TypeVar("Schema", bound=BaseModel)
# Largest TOML file read, [bytes]; a usual one has a few kB.
MAX_BYTES = 1 << 20
# A wrong value may be a whole table; messages show this many letters of it.
MAX_SHOWN = 60
T = TypeVar("T")
Nested = dict[str, Any]
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word", tuple: "a list"}


def read_toml(path: Path, model: type[Schema], absent: str) -> Schema:
    """Parse and validate one file.

    Args:
        path: TOML.
        model: Schema of the whole file.
        absent: Remedy if the file is missing.

    Raises:
        MissingFileError, LimitExceededError: No such file, or larger than 1 MiB.
        MalformedFileError: Not TOML, an unknown key (the nearest known one is named), a wrong
            type or a missing key.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", absent)
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    try:
        data = tomllib.loads(path.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid TOML ({error})", "correct that line") from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(path, *complaint(error, model)) from error


def complaint(error: ValidationError, model: type[BaseModel]) -> tuple[str, str]:
    """Problem and remedy of the first error in a file.

    Args:
        error: Error of the validation by `model`.
        model: The schema of the whole file.
    """
    # An unknown key often explains a missing one, so it is named first.
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    place = ".".join(str(item) for item in first["loc"])
    known = _known_keys(model, first["loc"][:-1])
    if first["type"] == "extra_forbidden":
        return f"key '{place}' is unknown", suggest(str(first["loc"][-1]), known)
    if first["type"] == "missing":
        return f"key '{place}' is missing", "add it"
    return f"'{place}' is {repr(first['input'])[:MAX_SHOWN]}: {first['msg']}", "correct that value"


def _known_keys(model: type[BaseModel], place: tuple[Any, ...]) -> list[str]:
    """Keys of the table at a place; positions in lists are passed over."""
    for name in place:
        if isinstance(name, str) and name in model.model_fields:
            model = _table(model.model_fields[name].annotation) or model
    return list(model.model_fields)


def _table(annotation: Any) -> type[BaseModel] | None:
    """The schema inside an annotation such as `list[CameraSection]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_table, get_args(annotation))), None)


def override(params: T, changes: Mapping[str, Any], where: str) -> T:
    """A dataclass of parameters with some of its fields changed, those of nested dataclasses too.

    Args:
        params: Default parameters.
        changes: Values by field; a mapping for a nested dataclass.
        where: Name of the dataclass in messages, for example "motion.joint".

    Raises:
        ConfigError: No such field, or a value of another type.
    """
    known = {item.name: getattr(params, item.name) for item in fields(params)}  # type: ignore[arg-type]
    changed: dict[str, Any] = {}
    for name, value in changes.items():
        place = f"{where}.{name}"
        if name not in known:
            raise ConfigError(f"parameter '{place}'", "is unknown", suggest(name, known))
        old = known[name]
        if is_dataclass(old) and isinstance(value, Mapping):
            changed[name] = override(old, value, place)
        elif isinstance(old, float) and type(value) in (int, float):
            changed[name] = float(value)
        elif type(value) is type(old) and isinstance(value, bool | int | str):
            changed[name] = value
        elif isinstance(old, tuple) and isinstance(value, list):
            changed[name] = _tuple(value)
        else:
            kind = KINDS.get(type(old), "its fields by name")
            raise ConfigError(
                f"parameter '{place}'", f"is {value!r}", f"expected {kind}; its default is {old!r}"
            )
    return replace(params, **changed)  # type: ignore[type-var]


def _tuple(values: list[Any]) -> tuple[Any, ...]:
    """A list as dataclasses hold it, its numbers as fractions."""
    plain = (float(item) if type(item) is int else item for item in values)
    return tuple(_tuple(item) if isinstance(item, list) else item for item in plain)


def parse_setting(text: str) -> Nested:
    """`motion.joint.nodes=30` as nested tables; a value in brackets is a list in JSON.

    Raises:
        ConfigError: It is not of that form.
    """
    name, equals, value = text.partition("=")
    parts = name.strip().split(".")
    if not equals or not value.strip() or not all(parts):
        raise ConfigError(f"--set {text}", "is not a parameter", "for example --set motion.joint.nodes=30")
    nested: Any = _list(text, value.strip()) if value.strip().startswith("[") else _number(value.strip())
    for part in reversed(parts):
        nested = {part: nested}
    return nested


def _list(text: str, value: str) -> list[Any]:
    try:
        return json.loads(value)
    except json.JSONDecodeError as error:
        raise ConfigError(f"--set {text}", f"is not a list ({error})", "for example [0.0, 0.3]") from error


def merge(first: Nested, second: Nested) -> Nested:
    """Two nested tables in one; the second wins."""
    merged = dict(first)
    for name, value in second.items():
        old = merged.get(name)
        if isinstance(old, dict) and isinstance(value, dict):
            value = merge(old, value)
        merged[name] = value
    return merged


def flatten(nested: Nested, prefix: str = "") -> dict[str, Any]:
    """Values by dotted name."""
    flat: dict[str, Any] = {}
    for name, value in nested.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _number(text: str) -> bool | int | float | str:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def format_toml_value(value: Any) -> str:
    """A text, a number or a list of them in TOML, whose strings are JSON's but for the delete character.

    Raises:
        ConfigError: A text that UTF-8 cannot hold.
    """
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ConfigError(ascii(value), "is not a Unicode name", "rename the file or folder") from error
    return text
