"""TOML files held to a schema; what is wrong is said in the words of whoever wrote the file."""

import difflib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError

Schema = TypeVar("Schema", bound=BaseModel)
# Largest TOML file read, [bytes]; a usual one has a few kB.
MAX_BYTES = 1 << 20
# A wrong value may be a whole table; so many letters of it are shown.
MAX_SHOWN = 60


def read_toml(path: Path, model: type[Schema], absent: str) -> Schema:
    """Parse and validate one file.

    Args:
        path: TOML.
        model: Schema of the whole file.
        absent: What to do when it is missing.

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
    """Problem and remedy of the first thing that is wrong with a file.

    Args:
        error: What validation by `model` raised.
        model: The schema of the whole file.
    """
    # An unknown key explains the missing one beside it, so it is named first.
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    place = ".".join(str(item) for item in first["loc"])
    known = _known_keys(model, first["loc"][:-1])
    if first["type"] == "extra_forbidden":
        return f"key '{place}' is unknown", suggest(str(first["loc"][-1]), known)
    if first["type"] == "missing":
        return f"key '{place}' is missing", "add it"
    return f"'{place}' is {repr(first['input'])[:MAX_SHOWN]}: {first['msg']}", "correct that value"


def suggest(word: str, known: Iterable[str]) -> str:
    """The known word that was probably meant, else all of them."""
    words = list(known)
    near = difflib.get_close_matches(word, words, 1)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(words)}"


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
