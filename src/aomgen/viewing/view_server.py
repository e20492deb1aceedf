"""Pages of a run's twin and episodes on 127.0.0.1."""

from pathlib import Path
from typing import Final

from aomgen.viewing.opened import ViewedFolder
from aomgen.viewing.review_pages import list_review_routes
from aomgen.viewing.twin_pages import TwinPages
from aomgen.web.page_server import PageServer, send_file

PACKAGE: Final = "aomgen.viewing"


class ViewServer(PageServer):
    """Serves the pages of a run or of a single capture; see `PageServer`."""

    def __init__(self, folder: Path, port: int) -> None:
        """Open a run or a capture, and bind to 127.0.0.1.

        Raises:
            InputError, ConfigError: The folder contains neither a run nor a capture, or the port is taken.
        """
        viewed = ViewedFolder(folder)
        routes = {
            "GET /pages.css": send_file(PACKAGE, "pages.css"),
            "GET /pages.js": send_file(PACKAGE, "pages.js"),
            **TwinPages(viewed).list_routes(),
            **list_review_routes(viewed.last.results.out),
        }
        super().__init__(routes, port)
