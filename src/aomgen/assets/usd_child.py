"""Entry of the child process that parses one USD file: `python -m aomgen.assets.usd_child IN OUT`.

Writes OUT (see `archive.py`); an error of ours becomes a JSON line on
standard error and exit code 3, anything else is a crash that the parent reports.
"""

import json
import resource
import sys
from pathlib import Path

from aomgen.assets.archive import save_asset
from aomgen.assets.usd_parse import parse_usd
from aomgen.errors import AomgenError

# Address space of the child, [bytes]: the largest asset that is read needs a part of it.
MAX_MEMORY_BYTES = 8 << 30
# Exit code of an asset that is refused with a message; 1 and 2 are the interpreter's own.
REFUSED = 3


def main(arguments: list[str]) -> int:
    """Parse `arguments[0]` into `arguments[1]`; returns the exit code."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        save_asset(parse_usd(Path(arguments[0])), Path(arguments[1]))
    except AomgenError as error:
        answer = {"error": type(error).__name__, "where": error.where, "problem": error.problem}
        sys.stderr.write(json.dumps({**answer, "remedy": error.remedy}) + "\n")
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
