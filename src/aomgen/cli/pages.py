"""Options and server loop of the commands that serve a web page."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from aomgen.web.page_server import PageServer

PagePort = Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 selects a free port.")]
OpenBrowser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")]


def serve_pages(server: "PageServer", sentence: str, *, browser: bool) -> None:
    """Print a sentence with the address, open a browser if requested, and serve until the server is stopped."""
    import webbrowser

    print(f"{sentence} {server.url}", flush=True)
    if browser:
        webbrowser.open(server.url)
    server.serve_forever()
