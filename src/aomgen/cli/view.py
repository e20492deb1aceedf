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
    export: Annotated[
        Path | None,
        typer.Option(help="Write one HTML file that opens without AOMGen and offline, and serve nothing."),
    ] = None,
) -> None:
    """Show a run in a browser: its twin from any camera in any state, and its episodes; Ctrl+C ends it."""
    import webbrowser

    if export is not None:
        from aomgen.viewing.offline_page import write_offline_page

        print(f"wrote {export}, {write_offline_page(out, export) / 1e6:.1f} MB")
        return
    from aomgen.viewing.view_server import ViewServer

    with ViewServer(out, port) as server:
        print(f"view {out} at {server.url}", flush=True)
        if browser:
            webbrowser.open(server.url)
        server.serve_forever()
