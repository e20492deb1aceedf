"""`aomgen view`: show a run in a browser."""

from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.pages import OpenBrowser, PagePort, serve_pages


def view(
    out: Annotated[Path, typer.Argument(help="Folder of a run (finished or not) or of a capture.")],
    port: PagePort = 8766,
    browser: OpenBrowser = True,
    export: Annotated[
        Path | None,
        typer.Option(
            help="Write one HTML file that can be opened offline without AOMGen, instead of serving pages."
        ),
    ] = None,
) -> None:
    """Show the twin and the episodes of a run in a browser.

    Ctrl+C ends the command.
    """
    if export is not None:
        from aomgen.viewing.offline_page import write_offline_page

        print(f"wrote {export}, {write_offline_page(out, export) / 1e6:.1f} MB")
        return
    from aomgen.viewing.view_server import ViewServer

    with ViewServer(out, port) as server:
        serve_pages(server, f"view {out} at", browser=browser)
