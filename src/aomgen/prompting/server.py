"""Web page on 127.0.0.1 on which a person marks the parts of a capture."""

import base64

from aomgen.capture.capture_schema import Four, PromptSection
from aomgen.io.images import encode_png
from aomgen.prompting.session import PromptSession, box_of_mask, find_missing
from aomgen.web.page_server import (
    PageRequest,
    PageServer,
    RequestFields,
    Response,
    send_file,
    send_jpeg,
    send_json,
)


class ImageRequest(RequestFields):
    """Number of a scan image."""

    index: int


class MaskRequest(RequestFields):
    """Request of the mask of a prompt with points and box."""

    image: int
    part: str
    points: tuple[tuple[float, ...], ...] = ()
    box: Four | None = None


class SaveRequest(RequestFields):
    """Request to save all prompts and other statements about a capture."""

    prompts: list[PromptSection]
    category: str
    instruction: str


class PromptServer(PageServer):
    """Server of one session until the person presses "Done"; see `PageServer`."""

    def __init__(self, session: PromptSession, port: int) -> None:
        self.session = session
        routes = {
            "GET /": send_file("aomgen.prompting", "page.html"),
            "GET /api/state": self._get_state,
            "GET /api/image": self._get_image,
            "POST /api/mask": self._post_mask,
            "POST /api/save": self._post_save,
            "POST /api/done": self._post_done,
        }
        super().__init__(routes, port)

    def _get_state(self, request: PageRequest) -> Response:
        return send_json(self.session.describe())

    def _get_image(self, request: PageRequest) -> Response:
        return send_jpeg(self.session.images.read(self._check_index(request.parse(ImageRequest).index)))

    def _post_mask(self, request: PageRequest) -> Response:
        prompt = request.parse(MaskRequest)
        index = self._check_index(prompt.image)
        mask = self.session.segment(index, prompt.part, prompt.points, prompt.box or [])
        if mask is None:
            return send_json({"mask": "", "box": []})
        png = base64.b64encode(encode_png(mask.astype("uint8") * 255)).decode()
        return send_json({"mask": png, "box": box_of_mask(mask)})

    def _post_save(self, request: PageRequest) -> Response:
        save = request.parse(SaveRequest)
        self.session.save(save.prompts, save.model_dump(include={"category", "instruction"}))
        return send_json({"missing": find_missing(save.prompts)})

    def _post_done(self, request: PageRequest) -> Response:
        self.stop()
        return send_json({})

    def _check_index(self, index: int) -> int:
        if not 0 <= index < len(self.session.images.names):
            raise IndexError(f"the scan has no image {index}")
        return index
