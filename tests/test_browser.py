"""The report in a real browser: on a light and on a dark screen, on a small one, and on paper."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.reporting.tables import Table
from problems import levitation, record_of

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason=f"needs one of {', '.join(NAMES)}")
DARK, LIGHT = 0, 1  # as Chromium numbers the reader's wish
LOOK = """<script>
const at = (e, name) => getComputedStyle(e)[name], all = (s) => [...document.querySelectorAll(s)];
addEventListener("load", () => { document.body.dataset.seen = encodeURIComponent(JSON.stringify({
  paper: at(document.body, "backgroundColor"), ink: at(document.body, "color"),
  bad: all("p.bad").map((e) => at(e, "color")), caption: all("caption").map((e) => at(e, "color")),
  images: all("img").map((e) => [e.complete, e.naturalWidth, e.getBoundingClientRect().width]),
  headings: all("h1, h2").map((e) => e.textContent), page: document.documentElement.scrollWidth,
  cut: all("h1, h2, p, figcaption, img").filter((e) => e.scrollWidth > e.clientWidth + 1).length,
  screen: innerWidth, fetched: performance.getEntriesByType("resource").map((e) => e.name),
})); });</script>"""


def browse(page, tmp_path, *options, scheme=LIGHT, width=900):
    """Open a page without any network and return what the browser prints."""
    command = [
        BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
        f"--user-data-dir={tmp_path / 'profile'}",
        f"--blink-settings=preferredColorScheme={scheme}",
        "--host-resolver-rules=MAP * ~NOTFOUND", f"--window-size={width},1200", *options,
        page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    return done.stdout.decode("utf-8", errors="replace")


def look(page, tmp_path, **settings):
    """Return what a script finds out about the page; the page itself has none."""
    looking = tmp_path / "looking.html"
    text = page.read_text("utf-8")
    looking.write_text(text.replace("</body>", f"{LOOK}</body>"), "utf-8")
    shown = browse(looking, tmp_path, "--dump-dom", **settings)
    seen = re.search(r'data-seen="([^"]*)"', shown)[1]
    return json.loads(re.sub("%([0-9A-F]{2})", lambda hit: chr(int(hit[1], 16)), seen))


def contrast(one, other):
    """Contrast of two CSS colours, as the accessibility guidelines define it."""

    def luminance(colour):
        parts = np.array([int(n) for n in re.findall(r"\d+", colour)[:3]]) / 255
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return linear @ [0.2126, 0.7152, 0.0722]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A report with every kind of chapter and bad news in it."""
    loop = levitation(free=())
    record = record_of(loop, swing=1e-4, hold=20, n=2000, seed=1, sensor_noise=1e-5)
    forced = cid.fit_arx(record, na=2, nb=2, constraints=[cid.Bounds("a1", -1.2, 0.0)])
    outcome = cid.redesign(loop.linearize(), replace(loop, controller=None), 100, 50)
    results = [record, forced, cid.compare(record, loop), outcome]
    return cid.write_report(results, tmp_path_factory.mktemp("page") / "report.html")


@pytest.mark.parametrize("scheme", [LIGHT, DARK])
def test_the_page_is_readable(page, tmp_path, scheme):
    seen = look(page, tmp_path, scheme=scheme)
    assert seen["headings"][0] == "ctrlid report"
    assert len(seen["headings"]) == 5
    assert len(seen["images"]) == 6
    assert all(done and wide > 500 and shown > 500 for done, wide, shown in seen["images"])
    assert seen["fetched"] == [] or all(name.startswith("data:") for name in seen["fetched"])
    assert (contrast(seen["paper"], "rgb(255, 255, 255)") < 1.01) == (scheme == LIGHT)
    assert contrast(seen["ink"], seen["paper"]) > 10
    assert len(seen["bad"]) >= 1
    for colour in (*seen["bad"], *seen["caption"]):
        assert contrast(colour, seen["paper"]) > 4.5


@pytest.mark.parametrize("width", [1400, 500])
def test_nothing_is_wider_than_the_screen(page, tmp_path, width):
    seen = look(page, tmp_path, width=width)
    assert seen["page"] <= seen["screen"]
    assert seen["cut"] == 0


@pytest.mark.parametrize(("scheme", "paper"), [(LIGHT, (255, 255, 255)), (DARK, (22, 24, 27))])
def test_a_picture_of_the_screen(page, tmp_path, scheme, paper):
    shot = tmp_path / "screen.png"
    browse(page, tmp_path, f"--screenshot={shot}", scheme=scheme)
    pixels = np.round(255 * matplotlib.image.imread(shot)[..., :3]).astype(int)
    assert tuple(pixels[3, 3]) == paper
    assert (np.abs(pixels - paper).sum(axis=2) > 200).mean() > 0.01  # something is written on it


def test_no_table_is_wider_than_the_paper(tmp_path):
    """The remarks about candidates were cut: what scrolls on a screen does not on paper."""
    words = "within 2 standard errors of its neutral value"
    rows = (("AsymmetricCoulombFriction at theta_dot", "1", "1234.5", "12.3", words),)
    table = cid.Section("What was tried", result=Table(("candidate", "", "", "", "remark"), rows))
    page = cid.write_report(table, tmp_path / "report.html")
    # The browser has a screen only, so that the rules for paper are put to work there.
    page.write_text(page.read_text("utf-8").replace("@media print", "@media all"), "utf-8")
    seen = look(page, tmp_path, width=640)
    assert seen["page"] <= seen["screen"]


@pytest.mark.parametrize("scheme", [LIGHT, DARK])
def test_it_prints_on_white_paper(page, tmp_path, scheme):
    sheet = tmp_path / "report.pdf"
    browse(page, tmp_path, "--no-pdf-header-footer", f"--print-to-pdf={sheet}", scheme=scheme)
    data = sheet.read_bytes()
    assert data.startswith(b"%PDF")
    pages = len(re.findall(rb"/Type\s*/Page\b", data))
    assert 3 <= pages <= 8
    assert len(re.findall(rb"/Subtype\s*/Image", data)) >= 6
