"""`python -m benchmarks NAME ...`: every number in README and docs comes from here."""

import typer

from aomgen.cli.run import COMMAND_LINE, run_command
from benchmarks.engine_commands import engine_app
from benchmarks.estimate_commands import estimate_app
from benchmarks.generate_commands import generate_app

app = typer.Typer(
    **COMMAND_LINE, add_completion=False, help="Measure: every number in README and docs comes from here."
)
for commands in (estimate_app, generate_app, engine_app):
    app.add_typer(commands)

if __name__ == "__main__":
    run_command(app)
