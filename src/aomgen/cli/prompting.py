"""`aomgen prompts`: mark robot and object parts in a browser."""

from pathlib import Path
from typing import Annotated

import typer


def prompts(
    capture: Annotated[Path, typer.Argument(help="Folder with a capture.toml.")],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for any free one.")
    ] = 8765,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Mark the robot, the object's body and its moving part on scan images, in a browser.

    Click on a part, and its mask appears; shift-click what does not belong to it, or drag a box. Each part
    wants a box on two images. "Save" replaces the [[prompts]] of capture.toml and nothing else; "Done" ends the
    command.
    """
    import webbrowser

    from aomgen.prompting.server import PromptServer
    from aomgen.prompting.session import PromptSession, find_missing

    session = PromptSession(capture)
    if session.no_masks:
        print(f"warning: there are no masks: {session.no_masks}")
    with PromptServer(session, port) as server:
        print(f"mark the parts at {server.url}", flush=True)
        if browser:
            webbrowser.open(server.url)
        server.serve_forever()
    missing = find_missing(session.prompts)
    for part, count in missing.items():
        print(f"  missing: {part} on {count} more image{'s' if count > 1 else ''}")
    if not missing:
        print(f"all parts are marked; next: aomgen check {capture}")
