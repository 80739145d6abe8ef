"""The page: well-formed, complete in itself, with the numbers of the result in it."""

import base64
import struct
import zlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import plot
from ctrlid.reporting.tables import Table
from problems import record_of, redesigned_levitation, servo

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """What is in a page; raises where a tag is closed that was not open."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.open, self.images = [], [], [], []
        self.cells, self.paragraphs, self.bad = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append((tag, dict(attrs)))
        if tag == "img":
            self.images.append(dict(attrs))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        tag, attributes = self.open[-1] if self.open else ("", {})
        if tag in ("td", "th"):
            self.cells.append(data)
        if tag == "p":
            (self.bad if attributes.get("class") == "bad" else self.paragraphs).append(data)


def check_png(source):
    """Decode an embedded picture to its last byte, by hand."""
    head, data = source.split(",", 1)
    assert head == "data:image/png;base64"
    raw = base64.b64decode(data, validate=True)
    assert raw[:8] == b"\x89PNG\r\n\x1a\n"
    at, pixels, size = 8, b"", None
    while at < len(raw):
        length, kind = struct.unpack(">I4s", raw[at : at + 8])
        body = raw[at + 8 : at + 8 + length]
        (crc,) = struct.unpack(">I", raw[at + 8 + length : at + 12 + length])
        assert crc == zlib.crc32(kind + body)
        if kind == b"IHDR":
            size = struct.unpack(">II", body[:8])
        pixels += body if kind == b"IDAT" else b""
        at += 12 + length
    assert min(size) > 100
    assert len(zlib.decompress(pixels)) > size[0] * size[1]


def read(path):
    text = path.read_text("utf-8")
    assert text.startswith("<!DOCTYPE html>")
    page = Page(text)
    for name, value in page.attributes:
        if name in ("src", "href"):
            assert value.startswith("data:")
    assert "http" not in text
    assert "script" not in page.tags
    assert "@import" not in text
    assert "url(" not in text
    for image in page.images:
        assert image["alt"]
        check_png(image["src"])
    return page


@pytest.fixture(scope="module")
def record():
    loop = servo()
    made = record_of(loop, swing=0.1, hold=50, n=800, seed=1, sensor_noise=2e-3)
    return loop, replace(made, units={"r": "m", "u": "V", "y": "m"})


@pytest.fixture(scope="module")
def outcome():
    return redesigned_levitation()


def test_page_of_a_record(record, tmp_path):
    path = tmp_path / "report.html"
    assert cid.write_report(record[1], path) == path
    page = read(path)
    assert len(page.images) == 1
    assert {"r", "m", "V", f"{record[1].u.max():.6g}"} <= set(page.cells)


def test_page_of_a_record_with_gaps_and_other_channels(record, tmp_path):
    valid = np.ones(800, bool)
    valid[:200] = False
    made = cid.Record(u=record[1].u, y=record[1].y, dt=0.01, hold="foh", valid=valid,
                      extra={"current": record[1].u})  # fmt: skip
    cid.write_report(made, tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text("utf-8")
    assert "75.0 % of them valid, whose numbers are these; u is a straight line between" in text
    assert "not given" in read(tmp_path / "r.html").cells
    assert "current" in read(tmp_path / "r.html").cells


def test_page_of_a_model(record, tmp_path):
    G = cid.fit_arx(record[1], na=2, nb=2)
    page = read(cid.write_report(G, tmp_path / "r.html"))
    assert len(page.images) == 2
    assert {"a1", f"{G.estimate['a1']:.7g}"} <= set(page.cells)
    assert "pole in s [rad/s]" in page.cells


def test_bad_news_of_a_model_stands_out(record, tmp_path):
    G = cid.fit_arx(record[1], na=2, nb=2, constraints=[cid.Bounds("a1", -1.0, 0.0)])
    page = read(cid.write_report(G, tmp_path / "r.html"))
    assert "on its bound" in page.cells
    assert any("IS ON ITS BOUND" in text for text in page.bad)
    fixed = cid.fit_arx(record[1], na=2, nb=2, constraints=[cid.Fixed("a2", 0.9)])
    assert "fixed" in read(cid.write_report(fixed, tmp_path / "f.html")).cells


def test_page_of_a_comparison(record, tmp_path):
    found = cid.compare(record[1], record[0])
    page = read(cid.write_report(found, tmp_path / "r.html"))
    assert len(page.images) == 2
    for curve in found.curves:
        assert curve.label in page.cells
        assert f"{curve.fit:.2f} %" in page.cells
    assert "RMS error [m]" in page.cells
    assert " ".join(found.verdict.split()) in [*page.paragraphs, *page.bad]


def test_page_of_a_comparison_without_noise(record, tmp_path):
    clean = cid.simulate(record[0], record[1].r)
    found = cid.compare(clean, record[0])
    assert found.tests == ()
    assert len(read(cid.write_report(found, tmp_path / "r.html")).images) == 1
    with pytest.raises(
        cid.CtrlidError, match=r"nothing to draw: the one-step errors .* not tested"
    ):
        plot.residuals(found)


def test_page_of_physical_parameters(record, tmp_path):
    loop = replace(record[0], free=("k", "c"))
    fitted = cid.fit_loop(loop, record[1])
    page = read(cid.write_report(fitted, tmp_path / "r.html"))
    assert len(page.images) == 2
    assert {"k", f"{fitted.estimate['k']:.7g}", "standard error"} <= set(page.cells)
    assert any(
        text.startswith("Standard deviation of the sensor noise: ") for text in page.paragraphs
    )
    assert any("servo, " in text for text in page.paragraphs)
    lost = replace(fitted.estimate, covariance=np.diag([np.inf, 1e-6]), active=("c",))
    cells = read(cid.write_report(replace(fitted, estimate=lost), tmp_path / "l.html")).cells
    assert "not determined by the data" in cells
    assert "on its bound" in cells


def test_page_of_a_long_record_shows_a_part_too(tmp_path):
    r = cid.random_binary(4000, amplitude=1.0, hold=20, seed=1)
    page = read(cid.write_report(cid.Record(r=r, u=r, y=r, dt=0.01), tmp_path / "r.html"))
    assert [image["alt"] for image in page.images] == ["The experiment.", "A part of it."]


def test_standard_errors_are_qualified_where_they_need_it(record, tmp_path):
    for fit, said in ((cid.fit_arx, True), (cid.fit_iv, False)):
        G = fit(replace(record[1], hold="zoh"), na=2, nb=2)
        text = cid.write_report(G, tmp_path / "r.html").read_text("utf-8")
        assert ("valid only if the errors are white" in text) == said


def test_page_of_a_redesign(outcome, tmp_path):
    page = read(cid.write_report(outcome, tmp_path / "r.html"))
    assert any(text.startswith("Controller: (") and "falling powers of s" in text
               for text in page.paragraphs)  # fmt: skip
    assert {"final value per step", outcome.rows[0][1]} <= set(page.cells)
    assert len(page.images) == 1
    assert "promised on the model" in page.cells
    assert f"{outcome.achieved.phase_margin:.2f}" in page.cells
    assert outcome.verdict in page.paragraphs
    achieved = replace(outcome.achieved, stable=False, phase_margin=np.nan)
    lost = replace(outcome, achieved=achieved)
    page = read(cid.write_report(lost, tmp_path / "lost.html"))
    assert any("DOES NOT STABILIZE THE PHYSICS" in text for text in page.bad)


def test_sections_in_their_order(record, tmp_path):
    table = Table(("what", "how much"), (("ball", "21.3 g"),), "The apparatus.")
    chapters = [
        cid.Section("First & foremost", "a < b.\n\nSecond\nparagraph.", table),
        cid.Section("Drawn", figure=plot.record(record[1])),
        cid.Section("Bytes", result=(table, record[1]),
                    figure={"A picture.": plot.png(plot.record(record[1]))}),
        cid.Section("No picture", result=record[1], figure={}),
        record[1], table,
    ]  # fmt: skip
    path = cid.write_report(chapters, tmp_path / "story.html", title="A <story>")
    page, text = read(path), path.read_text("utf-8")
    assert "<h1>A &lt;story&gt;</h1>" in text
    assert "<title>A &lt;story&gt;</title>" in text
    assert page.paragraphs[:2] == ["a < b.", "Second paragraph."]
    titles = ("First &amp; foremost", "Drawn", "Bytes", "No picture", "Record servo",
              "The apparatus.")  # fmt: skip
    places = [text.index(f"<h2>{t}</h2>") for t in titles]
    assert places == sorted(places)
    assert [i["alt"] for i in page.images] == ["Drawn", "A picture.", "The experiment."]


def test_one_result_has_one_heading(record, tmp_path):
    text = cid.write_report(cid.Section("Alone", "Words."), tmp_path / "r.html").read_text("utf-8")
    assert "<h1>Alone</h1>" in text
    assert "<h2>" not in text


def test_page_suits_dark_screens_and_paper(tmp_path):
    text = cid.write_report(cid.Section("A", "B"), tmp_path / "r.html").read_text("utf-8")
    assert "@media (prefers-color-scheme: dark)" in text
    on_paper = text[text.index("@media print") :]
    assert "tbody th, td:last-child { white-space: normal; }" in on_paper
    assert "figure img { display: block; width: 100%; height: auto; background: #ffffff" in text


def test_same_result_same_page(record, tmp_path):
    one, other = (cid.write_report(record[1], tmp_path / n) for n in ("a.html", "b.html"))
    assert one.read_bytes() == other.read_bytes()


def test_what_cannot_be_reported_is_refused(record, tmp_path):
    with pytest.raises(
        cid.CtrlidError, match=r"a report shows a Record, .* sequence of them; given int"
    ):
        cid.write_report(3, tmp_path / "r.html")
    with pytest.raises(cid.CtrlidError, match="given complex"):
        cid.write_report(cid.Section("A", result=3j, figure={}), tmp_path / "r.html")
    with pytest.raises(cid.CtrlidError, match="at least one result; given an empty sequence"):
        cid.write_report([], tmp_path / "r.html")
    with pytest.raises(cid.CtrlidError, match="given str"):
        cid.write_report("text", tmp_path / "r.html")
    with pytest.raises(
        cid.CtrlidError, match=r"cannot be written to .*Give a file in a folder that exists"
    ):
        cid.write_report(record[1], tmp_path / "nowhere" / "r.html")
    assert list(tmp_path.iterdir()) == []


def test_table_rows_are_as_wide_as_the_head():
    with pytest.raises(cid.CtrlidError, match=r"needs 2 cells; given \('a',\)"):
        Table(("x", "y"), (("a",),))
    assert str(Table(("x", "y"), (("a", "10"),), "Title")) == "Title\nx    y\na   10"


def test_an_audit_is_a_table_on_a_page(tmp_path):
    u = np.repeat([0.0, 1.0, 0.0, 1.0], 50)
    record = cid.Record(u=u, y=np.minimum(np.cumsum(u - 0.5), 12.0), dt=0.1)
    found = cid.audit(record)
    page = cid.write_report([record, found], tmp_path / "audit.html").read_text("utf-8")
    assert "Audit of a record" in page
    assert all(f.kind in page for f in found.findings)
    clean = cid.Record(u=u, y=np.random.default_rng(1).standard_normal(200), dt=0.1, r=u)
    made = cid.write_report(cid.audit(clean), tmp_path / "clean.html").read_text("utf-8")
    assert "Audit of a record" in made
