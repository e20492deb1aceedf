"""User input: TOML files that follow a schema, and changes of the stages' parameters by name.

Messages describe problems by the keys of the file.
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
# Largest TOML file that is read, [bytes]; common ones have a few kB.
MAX_BYTES = 1 << 20
# Number of characters of a wrong value that messages show; the value may be a whole table.
MAX_SHOWN = 60
T = TypeVar("T")
Nested = dict[str, Any]
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word", tuple: "a list"}


def read_toml(path: Path, model: type[Schema], absent: str) -> Schema:
    """Parse and validate a TOML file.

    Args:
        path: TOML file.
        model: Schema of the whole file.
        absent: Remedy in the message if the file is missing.

    Raises:
        MissingFileError, LimitExceededError: The file is missing, or larger than 1 MiB.
        MalformedFileError: The file is not TOML, has an unknown key (the message suggests the most similar one), misses a
            key, or has a value of the wrong type.
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
    """Return problem and remedy of the first error in a file, for messages.

    Args:
        error: Error that the validation with `model` raised.
        model: Schema of the whole file.
    """
    # An unknown key is often a misspelled missing one, so it is reported first.
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    place = ".".join(str(item) for item in first["loc"])
    known = _known_keys(model, first["loc"][:-1])
    if first["type"] == "extra_forbidden":
        return f"key '{place}' is unknown", suggest(str(first["loc"][-1]), known)
    if first["type"] == "missing":
        return f"key '{place}' is missing", "add it"
    return f"'{place}' is {repr(first['input'])[:MAX_SHOWN]}: {first['msg']}", "correct that value"


def _known_keys(model: type[BaseModel], place: tuple[Any, ...]) -> list[str]:
    """List the known keys of the table at a location in a file; indices of lists are skipped."""
    for name in place:
        if isinstance(name, str) and name in model.model_fields:
            model = _table(model.model_fields[name].annotation) or model
    return list(model.model_fields)


def _table(annotation: Any) -> type[BaseModel] | None:
    """Return the schema inside an annotation such as `list[CameraSection]`, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_table, get_args(annotation))), None)


def override(params: T, changes: Mapping[str, Any], where: str) -> T:
    """Change fields of a dataclass of parameters, including fields of nested dataclasses.

    Args:
        params: Default parameters.
        changes: New values by field; a mapping for a nested dataclass.
        where: Name of the dataclass in messages, for example "motion.joint".

    Returns:
        Changed copy of `params`.

    Raises:
        ConfigError: A field does not exist, or a value has another type than the default.
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
    """Convert a list, and lists inside it, to tuples, and integers to floats."""
    plain = (float(item) if type(item) is int else item for item in values)
    return tuple(_tuple(item) if isinstance(item, list) else item for item in plain)


def parse_setting(text: str) -> Nested:
    """Parse a setting such as `motion.joint.nodes=30` into nested dictionaries.

    A value in brackets is parsed as a JSON list; other values become a bool, an int, a float or else a string.

    Raises:
        ConfigError: The text does not have this form.
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
    """Merge two nested dictionaries; values of `second` replace those of `first`."""
    merged = dict(first)
    for name, value in second.items():
        old = merged.get(name)
        if isinstance(old, dict) and isinstance(value, dict):
            value = merge(old, value)
        merged[name] = value
    return merged


def flatten(nested: Nested, prefix: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries to values by dotted name, each name preceded by `prefix`."""
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
    """Format a string, a number or a list of them as TOML.

    JSON is valid TOML for these values, except that TOML requires the delete character to be escaped.

    Raises:
        ConfigError: A string cannot be encoded as UTF-8.
    """
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ConfigError(ascii(value), "is not a Unicode name", "rename the file or folder") from error
    return text
