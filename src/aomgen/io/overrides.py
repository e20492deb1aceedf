"""Parameters of stages, changed by name: what a project file and `--set` may say."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from aomgen.errors import ConfigError
from aomgen.io.schema import suggest

T = TypeVar("T")
Nested = dict[str, Any]
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}


def override(params: T, changes: Mapping[str, Any], where: str) -> T:
    """A dataclass of parameters with some of its fields changed, those of nested dataclasses too.

    Args:
        params: As they are by default.
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
        else:
            kind = KINDS.get(type(old), "its fields by name")
            raise ConfigError(f"parameter '{place}'", f"is {value!r}", f"want {kind}; its default is {old!r}")
    return replace(params, **changed)  # type: ignore[type-var]


def parse_setting(text: str) -> Nested:
    """`motion.joint.nodes=30` as nested tables.

    Raises:
        ConfigError: It is not of that form.
    """
    name, equals, value = text.partition("=")
    parts = name.strip().split(".")
    if not equals or not value.strip() or not all(parts):
        raise ConfigError(f"--set {text}", "is no parameter", "for example --set motion.joint.nodes=30")
    nested: Any = _number(value.strip())
    for part in reversed(parts):
        nested = {part: nested}
    return nested


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
