"""Record the pages of `aomgen view` for the documentation.

Run as `python scripts/record_view.py ADDRESS FILE.webp`, where `aomgen view OUT` serves ADDRESS. Needs Chromium.
"""

import io
import sys

from PIL import Image
from playwright.sync_api import Page, sync_playwright

# Time that each image is shown, [ms]: about 20 s in all.
SHOWN_MS = 250
WINDOW, SIZE = {"width": 1280, "height": 800}, (960, 600)
# WebP quality at which text stays readable; the file has some 0.6 MB.
QUALITY = 45


def record(page: Page, address: str) -> list[Image.Image]:
    """Play the recording, orbit, show overlays, and open the review and an episode."""
    frames = []

    def take(count: int, wait_ms: int) -> None:
        for _ in range(count):
            page.wait_for_timeout(wait_ms)
            image = Image.open(io.BytesIO(page.screenshot(type="jpeg", quality=85)))
            frames.append(image.resize(SIZE, Image.Resampling.LANCZOS))

    page.goto(address)
    page.wait_for_timeout(5000)
    page.keyboard.press("Space")
    take(22, 120)
    page.keyboard.press("Space")
    page.mouse.move(500, 400)
    page.mouse.down()
    for step in range(20):
        page.mouse.move(500 + 9 * step, 400 - 2 * step)
        take(1, 90)
    page.mouse.up()
    for name in ("axis", "colliders"):
        page.check(f"[data-toggle={name}]")
        take(3, 600)
    page.goto(f"{address}/review")
    page.wait_for_timeout(2500)
    take(8, 50)
    page.click(".card")
    page.wait_for_timeout(3000)
    page.keyboard.press("Space")
    take(20, 120)
    return frames


def main(address: str, file: str) -> None:
    """Write an animated WebP file."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        frames = record(browser.new_page(viewport=WINDOW), address.rstrip("/"))  # pyright: ignore[reportArgumentType]
        browser.close()
    options = {"duration": SHOWN_MS, "loop": 0, "quality": QUALITY, "method": 4}
    frames[0].save(file, save_all=True, append_images=frames[1:], **options)


if __name__ == "__main__":
    main(*sys.argv[1:])
