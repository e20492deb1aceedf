"""Pages on 127.0.0.1 that show a run: its twin and its episodes."""

from pathlib import Path
from typing import Final

from aomgen.viewing.review import list_review_routes
from aomgen.web.server import PageServer, send_file

PACKAGE: Final = "aomgen.viewing"


class ViewServer(PageServer):
    """Serves the pages of a run, or of a capture alone; see `PageServer`."""

    def __init__(self, folder: Path, port: int) -> None:
        """Open a run or a capture, and bind to 127.0.0.1.

        Raises:
            InputError, ConfigError: The folder holds neither, or the port is taken.
        """
        routes = {
            "GET /": send_file(PACKAGE, "twin.html"),
            "GET /pages.css": send_file(PACKAGE, "pages.css"),
            "GET /pages.js": send_file(PACKAGE, "pages.js"),
            **list_review_routes(folder),
        }
        super().__init__(routes, port)
