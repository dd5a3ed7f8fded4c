"""The report holds the numbers and pictures of its folder, needs nothing else, and is safe."""

import json
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

from lommel.errors import InputError
from lommel.io.raster import write_raster
from lommel.report import write_report
from lommel.report.claims import find_claims
from lommel.report.contents import read_contents
from lommel.scene.grid import grid_from_bounds, read_crs

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
UNCLOSED = {"meta", "img", "br"}


class Page(HTMLParser):
    """Tags that do not nest, attributes and visible text of a page."""

    def __init__(self, path):
        super().__init__()
        self.open, self.elements, self.words = [], [], []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in UNCLOSED:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    def attributes(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def test_every_element_of_the_page_is_closed(demo_report):
    assert Page(demo_report).open == []


def test_page_says_results_outcome_settings_stages_and_digests(demo_report):
    text = Page(demo_report).text
    for words in (
        "exposure rms 0.432 %",
        "albedo error 2.7 %",
        "Converged after 7 steps.",
        "image correlation 0.131 → 0.952",
        "height change rms 6.69 m",
        "reflectance lunar-lambert",
        "read images 1.25 310.5",
        "ab" * 32,
        "2026-01-02 03:04 UTC",
    ):
        assert words in text


def test_targets_stand_beside_the_results(demo_report):
    text = Page(demo_report).text
    assert "removed 0.5 % at most 1 " in text
    assert "removed 4.1 % at most 3 missed " in text


def test_page_loads_nothing_from_elsewhere(demo_report):
    page = demo_report
    content = page.read_text(encoding="utf-8")
    loaded = [
        value
        for _, attributes in Page(page).elements
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "data", "action")
    ]
    assert loaded
    assert all(value.startswith("data:image/png;base64,") for value in loaded)
    assert "url(" not in content
    assert "@import" not in content
    assert "<script" not in content


def test_hostile_names_are_text_not_markup(demo_report):
    page = Page(demo_report)
    assert '<img src=x onerror="alert(1)"> $a_b$ & co.tif does not overlap the DEM <b>' in page.text
    assert not page.attributes("b")
    assert not any("onerror" in attributes for _, attributes in page.elements)


def test_each_product_has_its_picture_beside_it(demo_report):
    for raster in demo_report.parent.glob("*/*.tif"):
        if raster.name != "initial-dem.tif":  # shown as the height change
            assert raster.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert (demo_report.parent / "albedo" / "exposures.png").exists()
    assert (demo_report.parent / "sfs" / "height-change.png").exists()


def test_every_picture_has_words(demo_report):
    images = Page(demo_report).attributes("img")
    assert len(images) == 16
    assert all(image["alt"] for image in images)


def test_stages_inside_the_folder_are_parts_of_the_page(demo_report):
    text = Page(demo_report).text
    first = text.index("Demonstration")
    assert first < text.index("Albedo and exposures") < text.index("Terrain refined")


def test_unused_images_are_listed_with_the_reason(demo_report):
    assert "AS16-M-0423.tif all shadow" in Page(demo_report).text


def test_missing_products_are_left_out(tmp_path):
    (tmp_path / "run.json").write_text(
        '{"command": "albedo", "outcome": {"sentence": "Stopped."}}', encoding="utf-8"
    )
    page = Page(write_report(tmp_path))
    assert page.attributes("img") == []
    assert "Albedo and exposures" in page.text


def test_the_after_picture_is_shown_without_the_before(sfs_folder):
    (sfs_folder / "hillshade-before.tif").unlink()
    claim = find_claims(read_contents(sfs_folder))[0]
    assert [panel.name for panel in claim.panels] == ["hillshade-after"]


def test_rasters_without_any_data_still_make_a_report(sfs_folder):
    grid = grid_from_bounds((0.0, 0.0, 1.0, 1.0), 3000.0, read_crs("IAU_2015:30100"))
    for raster in sfs_folder.glob("*.tif"):
        write_raster(raster, np.full(grid.shape, np.nan), grid, "nothing")
    assert write_report(sfs_folder).exists()


def test_writing_twice_gives_the_same_page(sfs_folder):
    first = write_report(sfs_folder).read_bytes()
    assert write_report(sfs_folder).read_bytes() == first


def test_folder_without_a_record_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(InputError, match=r"holds no run\.json.*Name a folder that a lommel"):
        write_report(tmp_path)


@pytest.mark.parametrize(
    "content, message",
    [
        ('{"command": "sfs"', "cannot be read as the record"),
        ("[1, 2]", "names no command"),
        ('{"settings": {}}', "names no command"),
        ('{"command": "sfs", "stages": 5}', "'stages' should be a list of dict, it is 5"),
        ('{"command": "sfs", "skipped": ["a"]}', "'skipped' should be a list of dict"),
    ],
)
def test_broken_record_is_refused_with_a_remedy(tmp_path, content, message):
    (tmp_path / "run.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        write_report(tmp_path)
    assert "repeat the run with --overwrite" in str(caught.value)


def test_foreign_exposure_table_is_refused(albedo_folder):
    (albedo_folder / "exposures.csv").write_text("name,value\na,1\n", encoding="utf-8")
    with pytest.raises(InputError, match="columns name, value; the report needs image"):
        write_report(albedo_folder)


def test_damaged_exposure_table_is_refused(albedo_folder):
    (albedo_folder / "exposures.csv").write_bytes(b"image,exposure\n\xff\xfe,1\n")
    with pytest.raises(InputError, match=r"exposures\.csv cannot be read"):
        write_report(albedo_folder)


def test_truncated_product_is_refused_by_name(sfs_folder):
    path = sfs_folder / "dem.tif"
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"dem\.tif cannot be"):
        write_report(sfs_folder)


def test_drawing_libraries_are_not_imported_before_a_report_is_written():
    code = "import sys, lommel.report; print(sorted({'matplotlib', 'jinja2'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine to load the page with")
def test_a_browser_shows_the_title_and_every_picture(demo_report, tmp_path):
    content = demo_report.read_text(encoding="utf-8")
    script = """<script>addEventListener("load", () => {
      const widths = [...document.images].map(image => image.naturalWidth);
      document.body.dataset.seen = JSON.stringify([document.title, widths.length,
        Math.min(...widths), document.documentElement.scrollWidth <= innerWidth]);
    })</script></body>"""
    page = tmp_path / "probed.html"
    page.write_text(content.replace("</body>", script), encoding="utf-8")
    options = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync "
        "--disable-background-networking --disable-component-update --dump-dom "
        "--virtual-time-budget=20000"
    ).split()
    command = [BROWSER, *options, f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    seen = dom.split('data-seen="')[1].split('"')[0].replace("&quot;", '"')
    title, images, narrowest, fits = json.loads(seen)
    assert title == "Demonstration: a simulated orbit strip – lommel"
    assert images == content.count("<img ") > 10
    assert narrowest > 500
    assert fits
