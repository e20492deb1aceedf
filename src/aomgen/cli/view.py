"""`aomgen view`: look at a run in a browser."""

from pathlib import Path
from typing import Annotated

import typer


def view(
    out: Annotated[Path, typer.Argument(help="Folder of a run, finished or not, or of a capture.")],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for any free one.")
    ] = 8766,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Show a run in a browser: its twin from any camera in any state, and its episodes; Ctrl+C ends it."""
    import webbrowser

    from aomgen.viewing.view_server import ViewServer

    with ViewServer(out, port) as server:
        print(f"view {out} at {server.url}", flush=True)
        if browser:
            webbrowser.open(server.url)
        server.serve_forever()
