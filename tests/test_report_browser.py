"""report.html in a real browser: drawn without error or network, zoomed, walked by keys, on a phone, on paper."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_cli import MLP, SPEC, make_project

import orthaug as oa
from orthaug import Channel, Response, Trajectory
from orthaug.commands.compare import page_of
from orthaug.commands.fit import write_result
from orthaug.commands.job import origin_of
from orthaug.reports.page import compare_page, fit_page
from orthaug.reports.page_compare import ComparePage
from orthaug.reports.page_fit import FitPage

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
pytestmark = [
    pytest.mark.skipif(
        CHROMIUM is None, reason="no Chromium is installed; set CHROMIUM to its file"
    ),
    pytest.mark.usefixtures("without_figures"),
]

ROWS = 100_000


def long_run(part: str) -> tuple[Response, Response]:
    """A record of many samples whose model runs away towards its end, in a test part."""
    time = np.arange(ROWS) / 1000
    model = np.sin(9 * time)[:, None]
    measured = model + 0.02 * np.random.default_rng(3).normal(size=model.shape)
    cut = np.where(np.arange(ROWS)[:, None] < 80_000, model, np.nan) if part != "train" else model
    diverged = (80_000, "y") if part != "train" else None
    run = Trajectory(cut, 0 * cut, 0 * cut, measured, 0, diverged=diverged)
    response = Response((run,), None, (Channel("y", "m"),), 0.001)
    return response, response


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Pages of a fit, of a comparison, and of a long record."""
    folder = tmp_path_factory.mktemp("pages")
    fitted = oa.fit_spec(
        str(make_project(folder, SPEC.replace('kind = "none"\n', MLP + "restarts = 3\n")))
    )
    long = FitPage(
        origin_of(fitted.job, "fit"), fitted.result, {p: long_run(p) for p in fitted.responses}
    )
    write_result(fitted, folder / "one")
    shutil.copytree(folder / "one", folder / "other")
    beside = oa.compare([str(folder / "one"), str(folder / "other")])
    pages = {
        "fit": fitted.report().html,
        "compared": compare_page(page_of(oa.compare(fitted.job))),
        "saved": compare_page(ComparePage(beside.origin, beside.result, beside.responses)),
        "long": fit_page(long),
    }
    for name, page in pages.items():
        (folder / f"{name}.html").write_text(page, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def opened(browser, folder):
    """Pages that several tests look at, each opened once."""
    kept: dict[tuple[str, str], Shown] = {}

    def page_of(name: str, scheme: str = "light"):
        if (name, scheme) not in kept:
            kept[name, scheme] = Shown(browser, folder / f"{name}.html", scheme=scheme)
        return kept[name, scheme].page

    yield page_of
    for shown in kept.values():
        shown.context.close()


class Shown:
    """A page that was opened and drawn, with what the browser complained of and asked for."""

    def __init__(self, browser, file: Path, width: int = 1280, scheme: str = "light"):
        self.context = browser.new_context(
            viewport={"width": width, "height": 844}, color_scheme=scheme
        )
        self.page, self.told, self.asked = self.context.new_page(), [], []
        self.page.on(
            "console",
            lambda m: self.told.append(m.text) if m.type in ("error", "warning") else None,
        )
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(file.as_uri())
        self.page.wait_for_selector("html[data-drawn]", state="attached")

    def __enter__(self):
        return self.page

    def __exit__(self, *_):
        self.context.close()


def until(page, condition: str) -> None:
    """Wait for a condition; what waits inside a page is forbidden there by its own policy."""
    for _ in range(100):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never true: {condition}")


def run_plot(page) -> str:
    """The selector of the first free run."""
    return f"#{page.locator('#free-run .plot').first.get_attribute('id')}"


def shown_range(page, plot: str) -> list[float]:
    return [
        float(end) for end in page.evaluate(f"document.querySelector('{plot}').layout.xaxis.range")
    ]


@pytest.mark.parametrize("name", ["fit", "compared", "saved", "long"])
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_page_is_drawn_without_error_and_network_and_fits_its_width(
    browser, folder, name, width, scheme
):
    shown = Shown(browser, folder / f"{name}.html", width, scheme)
    with shown as page:
        plots = page.locator(".plot").count()
        assert page.locator("html").get_attribute("data-drawn") == str(plots) and plots > 5
        assert page.locator(".plot .main-svg").count() >= plots
        assert shown.told == [] and shown.asked == [(folder / f"{name}.html").as_uri()]
        assert page.evaluate("document.documentElement.scrollWidth") == width
        wide = "[...document.querySelectorAll('main td, main th, main p, .plot, svg')].filter(e => "
        wide += (
            "e.getBoundingClientRect().right > innerWidth + 1 && getComputedStyle(e).position "
            "!== 'absolute')"
        )
        hidden = ".filter(e => !e.closest('thead') && !e.closest('pre')).length"
        assert width > 500 or page.evaluate(wide + hidden) == 0


@pytest.mark.parametrize(
    ("name", "scheme"), [("fit", "light"), ("fit", "dark"), ("compared", "light")]
)
def test_axe_finds_nothing(opened, name, scheme):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe is not installed"
    )
    page = opened(name, scheme)
    found = axe.Axe().run(page)
    assert found.violations_count == 0, found.generate_report()


def test_a_zoom_moves_every_panel_and_shows_more_of_a_long_record(opened):
    page = opened("long")
    plot = run_plot(page)
    curves = f"document.querySelector('{plot}').data"
    low, high = shown_range(page, plot)
    assert high - low == pytest.approx(0.399)  # 400 samples of 1 ms
    button = page.locator("#free-run .whole-record").first
    button.click()
    until(page, f"document.querySelector('{plot}').layout.xaxis.range[1] > 99")
    named = f"{curves}.filter(t => ['measured', 'model'].includes(t.name)).map(t => t.fill)"
    until(page, f'JSON.stringify({named}) == \'["toself","none"]\'')  # both are seen
    assert button.get_attribute("aria-pressed") == "true"
    assert page.evaluate(f"Math.max(...{curves}.map(t => t.x.length))") < 6000
    upper = page.locator(f"{plot} .nsewdrag").first
    upper.scroll_into_view_if_needed()
    box = upper.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.52 * box["width"], box["y"] + 50, steps=4)
    page.mouse.up()
    until(page, f"document.querySelector('{plot}').layout.xaxis.range[0] > 1")
    low, high = shown_range(page, plot)
    assert 49 < low < high < 53
    until(page, f"{curves}[0].x.length < 7000 && {curves}[0].x[1] - {curves}[0].x[0] < 0.0011")
    ranges = page.evaluate(f"{curves}.map(t => [t.xaxis ?? 'x', t.x[0], t.x.at(-1)])")
    assert len({tuple(entry) for entry in ranges}) == 1, (
        "all curves live on the same stretch of the same axis"
    )


def test_keys_move_zoom_and_reset_a_run(opened):
    page = opened("fit")
    plot = run_plot(page)
    whole = shown_range(page, plot)
    page.locator(plot).focus()
    page.keyboard.press("+")
    until(page, f"document.querySelector('{plot}').layout.xaxis.range[0] != {whole[0]}")
    near = shown_range(page, plot)
    assert near[1] - near[0] == pytest.approx((whole[1] - whole[0]) / 2)
    page.keyboard.press("ArrowRight")
    until(page, f"document.querySelector('{plot}').layout.xaxis.range[0] > {near[0]}")
    page.keyboard.press("0")
    until(page, f"document.querySelector('{plot}').layout.xaxis.range[0] == {whole[0]}")
    assert shown_range(page, plot) == whole


def test_the_contents_are_reached_and_followed_by_keys(browser, folder):
    page = Shown(browser, folder / "fit.html").page  # where nothing has the focus yet
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Tab")
    for link in page.locator("nav a").all():
        target = link.get_attribute("href")
        assert page.evaluate("document.activeElement.getAttribute('href')") == target
        page.keyboard.press("Tab")
    last = page.locator("nav a").last
    last.focus()
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#reproduce').getBoundingClientRect().top < innerHeight")
    assert page.url.endswith("#reproduce")


def test_folded_sections_open_by_their_link_with_whole_plots(opened):
    page = opened("fit")
    folded = page.locator("#residuals > .folded")
    assert folded.get_attribute("open") is None
    page.locator("nav a[href='#residuals']").click()
    until(page, "document.querySelector('#residuals > .folded').open")
    inside = "[...document.querySelectorAll('#residuals .plot')]"
    until(page, f"{inside}.every(p => p.layout.width === p.clientWidth && p.clientWidth > 0)")


def test_a_change_of_theme_colours_the_curves_anew(opened):
    page = opened("fit")
    color = (
        f"document.querySelector('{run_plot(page)}').data.find(t => t.name == 'model').line.color"
    )
    light = page.evaluate(color)
    page.emulate_media(color_scheme="dark")
    until(page, f"{color} != '{light}'")
    page.emulate_media(color_scheme="light")
    until(page, f"{color} == '{light}'")


def test_a_divergence_is_marked(opened):
    page = opened("long")
    assert "free run diverges in y" in page.locator("#free-run .plot").nth(1).inner_text()


def test_on_paper_every_plot_is_whole(opened):
    page = opened("fit", "dark")
    widths = "[...document.querySelectorAll('.plot')].map(p => p.layout.width)"
    page.evaluate(f"addEventListener('beforeprint', () => {{ window.seen = [{widths}, "
                  "getComputedStyle(document.documentElement).getPropertyValue('--paper').trim()]; })")  # fmt: skip
    paper = page.pdf(format="A4", prefer_css_page_size=True)
    seen, colour = page.evaluate("window.seen")
    assert colour in ("#ffffff", "#fff") and max(seen) <= 182 / 25.4 * 96, (
        "the width of A4 less its margins"
    )
    assert paper.startswith(b"%PDF") and 3 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", paper)) <= 20
    assert min(page.evaluate(widths)) > 0 and max(page.evaluate(widths)) > max(seen)


def _light(rgb: np.ndarray) -> float:
    """The relative luminance of a colour of three parts from 0 to 1, as WCAG defines it."""
    part = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(part @ [0.2126, 0.7152, 0.0722])


def _colour(text: str) -> np.ndarray:
    return np.array([int(text[i : i + 2], 16) for i in (1, 3, 5)]) / 255


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_numbers_in_the_cells_of_a_map_can_be_read(opened, scheme):
    page = opened("fit", scheme)
    (map_,) = page.evaluate(
        "[...document.querySelectorAll('.plot')].filter(p => p.layout.annotations?.length && "
        "p.data[0].type === 'heatmap').map(p => [p.data[0], p.layout.annotations])"
    )
    trace, written = map_
    scale = [(at, _colour(text)) for at, text in trace["colorscale"]]
    contrasts = []
    for cell in written:
        value = trace["z"][cell["y"]][cell["x"]]
        assert cell["text"] == trace["text"][cell["y"]][cell["x"]]
        share = (value - trace["zmin"]) / (trace["zmax"] - trace["zmin"])
        places, ends = zip(*scale, strict=True)
        shade = np.array([np.interp(share, places, part) for part in np.transpose(ends)])
        light = sorted([_light(shade), _light(_colour(cell["font"]["color"]))])
        contrasts.append((light[1] + 0.05) / (light[0] + 0.05))
    assert len(contrasts) == np.size(trace["z"]) > 5 and min(contrasts) >= 4.5
