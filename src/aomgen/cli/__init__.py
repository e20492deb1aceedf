"""The command line; `main` is the entry point."""

from aomgen.cli.app import main as main
