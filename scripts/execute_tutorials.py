"""Execute the tutorials on a finished run: python scripts/execute_tutorials.py RUN FOLDER [NAME...]

The executed notebooks are written to FOLDER; with docs/tutorials as FOLDER they replace those of the documentation. The first
error of a cell stops the command.
"""

import argparse
import os
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
# Longest duration of a cell, [s]: ten times that of the slowest on two idle cores.
CELL_TIMEOUT_S = 300
# The kernel would warn that its local connection is not encrypted.
KERNEL_ARGUMENTS = ["--log-level=ERROR"]
# What every notebook states about its kernel: the patch version of Python would differ between machines.
LANGUAGE = {"name": "python", "pygments_lexer": "ipython3"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="all tutorials when empty, for example 2_estimate_a_joint")
    options = parser.parse_args()

    os.environ["OUT"] = str(options.run.resolve())
    options.folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        if not options.names or path.stem in options.names:
            start = time.perf_counter()
            notebook = nbformat.read(path, as_version=4)
            client = NotebookClient(
                notebook,
                timeout=CELL_TIMEOUT_S,
                startup_timeout=CELL_TIMEOUT_S,
                record_timing=False,
                extra_arguments=KERNEL_ARGUMENTS,
            )
            client.execute(cwd=str(options.folder))
            notebook.metadata["language_info"] = LANGUAGE
            nbformat.write(notebook, options.folder / path.name)
            print(f"{path.name}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
