"""The live page in its four states, as the how-to on plants shows it; needs selenium and chromium.

    python docs/pictures/draw_live.py

On four supports of `caving`, gangue comes after the coal; the last accelerometer is upside down.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

import numpy as np
from selenium import webdriver

from cgid import Monitor
from cgid.plant import PlantOutputs
from cgid.scene import load_scene, parse_scene, record

HERE = Path(__file__).parent
#: Fraction of gangue of each support from 16 s on, and the length of the stream [s].
FRACTIONS, COAL, LENGTH = (0.03, 0.45, 0.9, 0.3), 15.0, 45.0


def main() -> None:
    """Draw it."""
    options = webdriver.ChromeOptions()
    for switch in ("--headless=new", "--no-sandbox", "--disable-gpu"):
        options.add_argument(switch)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    size = {"width": 1200, "height": 1490, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    supports = []
    for number, fraction in enumerate(FRACTIONS):
        content = json.loads(load_scene("caving").text)
        mixture = {"times": [0.0, COAL, COAL + 1, LENGTH], "gangue": [0.0, 0.0, fraction, fraction]}
        content["stream"] |= {"duration": LENGTH, "mixture": mixture}
        signal, _ = record(parse_scene(content), 11, number)
        supports.append(signal.samples.ravel())
    samples, rate = np.stack(supports, axis=1) * [1, 1, 1, -1], signal.sampling_rate
    names = ["31", "32", "33", "34"]
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "live.html"
        outputs = PlantOutputs(live=str(page))
        with Monitor(rate, names, "m/s^2", outputs=outputs, coal_until=COAL) as watch:
            for block in np.split(samples, range(2560, len(samples), 2560)):
                watch.feed(block)
            time.sleep(1.2)  # the page is written once a second
            browser.get(page.as_uri())
            time.sleep(0.5)
            browser.save_screenshot(str(HERE.parent / "how-to" / "live.png"))
    browser.quit()


if __name__ == "__main__":
    main()
