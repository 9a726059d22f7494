"""Screenshots of pages in a headless Chromium, at the widths of a desktop and of a phone.

``python docs/screenshots.py FOLDER PAGE.html ...`` writes FOLDER/PAGE_desktop.png and FOLDER/PAGE_phone.png, and says
which pages are wider than their window or had errors. It needs the group ``docs`` and a Chromium.
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

SIZES = {"desktop": (1280, 900), "phone": (390, 800)}
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def main(folder: Path, pages: list[Path]) -> int:
    """Take the screenshots; return the number of pages with something wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    found = 0
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for page in pages:
            for name, (width, height) in SIZES.items():
                tab = browser.new_page(viewport={"width": width, "height": height})
                wrong: list[str] = []
                tab.on("pageerror", lambda error, wrong=wrong: wrong.append(str(error)))
                tab.goto(page.resolve().as_uri(), wait_until="load")
                tab.wait_for_timeout(1500)
                wide = tab.evaluate("document.documentElement.scrollWidth")
                wrong += [f"{wide} pixels wide in a window of {width}"] if wide > width else []
                tab.screenshot(path=folder / f"{page.stem}_{name}.png")
                print(f"{page.name}, {name}: {'; '.join(wrong) or 'sound'}")
                found += bool(wrong)
                tab.close()
        browser.close()
    return found


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), [Path(page) for page in sys.argv[2:]]))
