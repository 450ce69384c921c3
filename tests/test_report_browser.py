"""The page in a real browser: what it shows is what the output says, by mouse and by keyboard."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_runs import estimated, mclass
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.select import Select
from test_report import HOSTILE, write_output

from mclass.cells import stored_report
from mclass.outputs.colors import CLASS_COLORS
from mclass.outputs.readback import OutputLog
from mclass.results import ObjectEstimate
from mclass.text.terminal import Terminal
from mclass.text.values import in_reading_order, mode_text, probability_text

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None,
    reason="no Chromium with its driver (Debian: apt-get install chromium chromium-driver)",
)

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
PATIENCE = 10.0
OWN_SCHEMES = ("chrome", "data:", "devtools:", "blob:")


@dataclass
class Browser:
    """A browser, and what tests ask of it."""

    driver: webdriver.Chrome

    def open(self, page: Path, width: int = 1300, scheme: str = "light") -> None:
        """Open a page and wait until it has drawn itself."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.logs("browser")
        self.logs("performance")
        self.driver.get(page.as_uri())
        eventually(lambda: self.run("return document.documentElement.dataset.ready"), "true")

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script returns, once the page has drawn what was asked of it before."""
        return self.driver.execute_script(script, *arguments)

    def find(self, selector: str) -> WebElement:
        return self.driver.find_element(By.CSS_SELECTOR, selector)

    def text(self, selector: str) -> str:
        """Text of an element, as it is in the document."""
        return str(self.run("return document.querySelector(arguments[0]).textContent", selector))

    def rows(self, selector: str) -> dict[str, list[str]]:
        """Texts of a table's rows, the first of each as the key."""
        script = """return [...document.querySelectorAll(arguments[0] + ' tbody tr')].map(
            (row) => [...row.cells].map((cell) => cell.innerText.trim()))"""
        return {row[0]: row[1:] for row in self.run(script, selector)}

    def press(self, selector: str, *keys: str) -> None:
        self.find(selector).send_keys(*keys)

    def logs(self, kind: str) -> list[dict[str, Any]]:
        """What has been logged since the last call."""
        return list(self.driver.get_log(kind))  # type: ignore[no-untyped-call]

    def requests(self) -> list[str]:
        """What the page asked for since it was opened, itself included."""
        events = [json.loads(entry["message"])["message"] for entry in self.logs("performance")]
        urls = [
            event["params"]["request"]["url"]
            for event in events
            if event["method"] == "Network.requestWillBeSent"
        ]
        return [url for url in urls if not url.startswith(OWN_SCHEMES)]


def eventually(look: Callable[[], Any], expected: Any) -> None:
    """Look again and again until something is as expected."""
    end = time.monotonic() + PATIENCE
    while (found := look()) != expected:
        assert time.monotonic() < end, f"{found!r} is not {expected!r}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    profile = tmp_path_factory.mktemp("profile")
    for flag in (*FLAGS.split(), f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(str(DRIVER))
    driver = webdriver.Chrome(options=options, service=service)
    try:
        yield Browser(driver)
    finally:
        driver.quit()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return estimated("cas_lab", tmp_path_factory.mktemp("lab"), "--every", "15")


@pytest.fixture(scope="module")
def page(lab: Path) -> Path:
    mclass("report", lab)
    return lab.with_suffix(".html")


@pytest.fixture
def opened(browser: Browser, page: Path) -> Iterator[Browser]:
    """The page, opened anew; whatever is done to it logs nothing and loads nothing."""
    browser.open(page)
    yield browser
    assert browser.logs("browser") == []
    assert browser.requests() == [page.as_uri()]


def shown(found: ObjectEstimate) -> dict[str, str]:
    """The bars of an object as the page must show them."""
    names = ("background", "physics_books", "robot_parts")
    values = found.class_probabilities.tolist()
    return {name: probability_text(value) for name, value in zip(names, values, strict=True)}


def bars(browser: Browser) -> dict[str, str]:
    return {name: texts[-1] for name, texts in browser.rows("#classes").items()}


class TestTime:
    def test_keys_on_the_slider_show_each_moment_s_belief(self, opened: Browser, lab: Path) -> None:
        with OutputLog.open(lab) as output:
            history, found = output.history(), output.measurements()
        opened.press("#slider", Keys.HOME)
        seen = set()
        for step in range(len(found)):
            stamp = int(found.stamps_ns[step])
            seconds = (stamp - int(found.stamps_ns[0])) / 1e9
            eventually(lambda: opened.text("#moment b"), f"t = {seconds:.3f} s")
            assert opened.text("#moment").endswith(", ".join(found.label_names_of(step)))
            assert opened.find("#slider").get_attribute("aria-valuetext") == opened.text("#moment")
            rows = opened.rows("#objects")
            for name, estimates in history.items():
                until = [estimate for estimate in estimates if estimate.stamp_ns <= stamp]
                if not until:
                    assert rows[name] == ["not seen yet"]
                    continue
                now = until[-1]
                expected = probability_text(now.class_probabilities[now.class_index + 1])
                assert rows[name][0].split("\n")[1].strip() == expected
                assert rows[name][2].split("\n") == [
                    mode_text(mode, Terminal()) for mode in in_reading_order(now.modes)
                ]
                assert rows[name][3] == str(now.measurements)
                row = sorted(history).index(name) + 1
                opened.press(f"#objects tbody tr:nth-child({row}) button", Keys.ENTER)
                eventually(lambda: bars(opened), shown(now))
                seen.add(tuple(bars(opened).values()))
            opened.press("#slider", Keys.ARROW_RIGHT)
        # Every measurement moved something.
        assert len(seen) == len(found)

    def test_dragging_the_slider_moves_the_moment(self, opened: Browser) -> None:
        before = opened.text("#moment")
        slider = opened.find("#slider")
        half = slider.size["width"] // 2
        actions = ActionChains(opened.driver)
        actions.move_to_element_with_offset(slider, half - 8, 0).click_and_hold()
        actions.move_by_offset(-half, 0).release().perform()
        eventually(lambda: slider.get_attribute("value"), "2")
        assert opened.text("#moment") != before
        assert "3 of 5 measurements" in opened.text("#moment")

    def test_says_which_map_is_shown(self, opened: Browser, lab: Path) -> None:
        with OutputLog.open(lab) as output:
            stamps = output.measurements().stamps_ns
            cuts = np.array([found.stamp_ns for found in output.maps_over_time(99)])
        assert len(cuts) == 4
        opened.press("#slider", Keys.HOME)
        for step, stamp in enumerate(stamps.tolist()):
            index = max(int((cuts <= stamp).sum()) - 1, 0)
            seconds = (int(cuts[index]) - int(stamps[0])) / 1e9
            sentence = f"The map shows the belief at t = {seconds:.3f} s (map {index + 1} of 4)."
            later = " That is later than the slider: no earlier map is stored."
            expected = sentence + (later if stamp < cuts[index] else "")
            eventually(lambda: opened.text("#map-time"), expected)
            assert opened.find("#slider").get_attribute("value") == str(step)
            opened.press("#slider", Keys.ARROW_RIGHT)

    def test_play_starts_over_moves_and_pauses(self, opened: Browser) -> None:
        opened.find("#play").click()
        eventually(lambda: opened.find("#slider").get_attribute("value"), "1")
        assert opened.text("#play") == "Pause"
        opened.press("#play", Keys.ENTER)
        eventually(lambda: opened.text("#play"), "Play")


def place_of(browser: Browser, x: float, y: float) -> tuple[int, int]:
    """Where a point of the plane [m] is on the canvas, from its centre [pixels]."""
    script = """const view = viewOf(extentOf(readDocument()),
            document.getElementById('map-box').clientWidth);
        return [view.x(arguments[0]) - view.width / 2, view.y(arguments[1]) - view.height / 2]"""
    right, down = browser.run(script, x, y)
    return round(right), round(down)


def assert_shows_cell(browser: Browser, lab: Path, x: float, y: float) -> None:
    """The readout is of the cell that holds a point, and has the numbers of its belief."""
    with OutputLog.open(lab) as output:
        block, names = output.belief_at(x, y), output.class_names
        report = stored_report(block, int(block.cells[0]))
    column, row = report.column, report.row
    eventually(lambda: f"row {row}, column {column}" in browser.text("#cell"), True)
    text = browser.text("#cell")
    assert text.startswith(
        f"x {report.center[0]:.2f}, y {report.center[1]:.2f} m".replace("-", "−")
    )
    assert f"{report.measurements} measurement" in text
    rows = browser.rows("#cell")
    assert set(rows) == {"background", *names}
    for index, name in enumerate(("background", *names)):
        probability = float(report.class_probabilities[index])
        if probability < 0.5e-4:
            assert rows[name][0] == "<0.0001"
        else:
            assert float(rows[name][0]) == pytest.approx(probability, abs=0.51e-4)
        if index:
            angles = [np.degrees(mode.orientation) for mode in report.modes[index - 1]]
            angle = float(rows[name][1].rstrip("°"))
            assert min(abs((angle - other + 180) % 360 - 180) for other in angles) < 0.6


class TestCells:
    @pytest.mark.parametrize(("x", "y"), [(2.1, -1.5), (4.1, 2.1), (4.5, -5.1)])
    def test_hover_shows_a_cell_s_belief(
        self, opened: Browser, lab: Path, x: float, y: float
    ) -> None:
        canvas = opened.find("#map")
        opened.run("arguments[0].scrollIntoView({block: 'center'})", canvas)
        right, down = place_of(opened, x, y)
        ActionChains(opened.driver).move_to_element_with_offset(canvas, right, down).perform()
        assert_shows_cell(opened, lab, x, y)
        ActionChains(opened.driver).move_to_element(opened.find("#things-title")).perform()
        eventually(lambda: opened.find("#cell").is_displayed(), False)

    def test_keys_move_the_cell(self, opened: Browser, lab: Path) -> None:
        opened.press("#map", Keys.ARROW_UP)
        # At the first object, whose place is known: (4, 2), in a cell of 0.2 m.
        assert_shows_cell(opened, lab, 4.1, 2.1)
        opened.press("#map", Keys.ARROW_LEFT)
        assert_shows_cell(opened, lab, 3.9, 2.1)
        opened.press("#map", Keys.ARROW_DOWN)
        assert_shows_cell(opened, lab, 3.9, 1.9)
        opened.press("#map", Keys.SHIFT, Keys.ARROW_UP)
        eventually(lambda: "y 3.9" in opened.text("#cell") or "prior" in opened.text("#cell"), True)
        opened.press("#map", Keys.ESCAPE)
        eventually(lambda: opened.find("#cell").is_displayed(), False)

    def test_a_cell_that_was_not_seen_holds_the_prior(self, opened: Browser) -> None:
        opened.press("#map", Keys.ARROW_UP)
        for _ in range(4):
            opened.press("#map", Keys.SHIFT, Keys.ARROW_DOWN)
        for _ in range(9):
            opened.press("#map", Keys.SHIFT, Keys.ARROW_LEFT)
        eventually(lambda: "not seen: the prior" in opened.text("#cell"), True)
        assert opened.rows("#cell")["background"][0] == "0.3333"

    def test_colours_are_the_probabilities(self, opened: Browser, lab: Path) -> None:
        for name in ("track", "rays", "objects"):
            opened.find(f"#show-{name}").click()
        Select(opened.find("#layer")).select_by_visible_text("P(robot_parts)")
        eventually(lambda: "P(robot_parts)" in opened.text("#legend"), True)
        with OutputLog.open(lab) as output:
            block = output.belief_at(2.1, -1.5)
        probability = float(np.exp(block.log_class_probability[0, 2]))
        assert 0.5 < probability < 0.7
        x, y = place_of(opened, 2.1, -1.5)
        script = """const map = document.getElementById('map');
            return [...map.getContext('2d').getImageData(
                arguments[0] + map.width / 2, arguments[1] + map.height / 2, 1, 1).data]"""
        expected = [round(255 + (part - 255) * probability) for part in CLASS_COLORS[1]]
        found = opened.run(script, x, y)
        np.testing.assert_allclose(found[:3], expected, atol=2)


class TestReach:
    def test_everything_is_reached_by_tab(self, opened: Browser) -> None:
        opened.run("document.activeElement.blur()")
        reached: list[str] = []
        for _ in range(14):
            ActionChains(opened.driver).send_keys(Keys.TAB).perform()
            reached.append(
                opened.run(
                    """const node = document.activeElement;
                    return node.id || node.textContent.trim().slice(0, 12)"""
                )
            )
        controls = ["play", "slider", "layer", "show-track", "show-rays", "show-objects", "map"]
        assert reached[: len(controls)] == controls
        assert {"o1", "o2", "o3"} <= set(reached)

    def test_an_object_is_picked_by_key(self, opened: Browser) -> None:
        opened.find("#objects tr:nth-child(2) button").send_keys(Keys.ENTER)
        eventually(lambda: opened.text("#object-title"), "Object o2")
        buttons = opened.driver.find_elements(By.CSS_SELECTOR, "#objects button")
        pressed = [button.get_attribute("aria-pressed") for button in buttons]
        assert pressed == ["false", "true", "false"]

    def test_controls_and_pictures_have_names(self, opened: Browser) -> None:
        unnamed = opened.run(
            """return [...document.querySelectorAll('input, select, button, canvas, svg')].filter(
                (node) => !(node.getAttribute('aria-label') || node.closest('label') ||
                    node.textContent.trim() || node.getAttribute('aria-hidden'))).length"""
        )
        assert unnamed == 0

    @pytest.mark.parametrize("scheme", ["light", "dark"])
    def test_text_stands_out(self, browser: Browser, page: Path, scheme: str) -> None:
        browser.open(page, scheme=scheme)
        colors = browser.run("return themeColors()")
        assert (luminance(colors["card"]) > 0.5) == (scheme == "light")
        for name in ("ink", "soft", "accent"):
            first, second = sorted((luminance(colors[name]), luminance(colors["card"])))
            assert (second + 0.05) / (first + 0.05) > 4.5, name

    @pytest.mark.parametrize("width", [400, 700, 1300])
    def test_nothing_sticks_out(self, browser: Browser, page: Path, width: int) -> None:
        browser.open(page, width=width)
        assert browser.run("return document.documentElement.scrollWidth") <= width

    def test_printed_on_white_and_in_full(self, browser: Browser, page: Path) -> None:
        browser.open(page, scheme="dark")
        browser.run("window.dispatchEvent(new Event('beforeprint'))")
        assert luminance(browser.run("return themeColors()")["card"]) == 1.0
        assert browser.run("return document.querySelector('details').open")
        browser.run("window.dispatchEvent(new Event('afterprint'))")
        assert luminance(browser.run("return themeColors()")["card"]) < 0.1


def luminance(color: str) -> float:
    """Relative luminance of ``#rrggbb``, as WCAG defines it."""
    parts = np.array([int(color[at : at + 2], 16) for at in (1, 3, 5)]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


class TestForeign:
    def test_hostile_names_are_shown_and_do_nothing(self, browser: Browser, tmp_path: Path) -> None:
        hostile = HOSTILE.replace("alert(1)", "window.harmed=1")
        script = "</script><script>window.harmed=2</script>"
        path = tmp_path / "out.mcap"
        write_output(path, names=(script, "b"), object_ids=(hostile, script), hostile=hostile)
        mclass("report", path)
        browser.open(tmp_path / "out.html")
        browser.press("#slider", Keys.HOME)
        browser.press("#slider", Keys.END)
        assert set(browser.rows("#objects")) == {hostile, script}
        assert hostile in browser.text("#facts")
        assert script in browser.text("#classes")
        assert hostile in browser.text("#moment") or script in browser.text("#moment")
        assert browser.run("return window.harmed") is None
        assert browser.run("return document.querySelectorAll('img, iframe, script').length") == 2
        assert browser.logs("browser") == []
        assert browser.requests() == [(tmp_path / "out.html").as_uri()]

    def test_what_cannot_be_shown_is_said(self, browser: Browser, page: Path) -> None:
        broken = page.with_name("broken.html")
        text = page.read_text(encoding="utf-8")
        begin = text.index('"data":"') + len('"data":"')
        broken.write_text(text[:begin] + "AAAA" + text[begin + 4 :], encoding="utf-8")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("test_report_browser.PATIENCE", 0.5)
            with pytest.raises(AssertionError):
                browser.open(broken)
        assert browser.text("#failure").startswith("This report cannot be shown: ")
        assert browser.find("#failure").is_displayed()

    def test_policy_forbids_what_the_page_does_not_hold(self, browser: Browser, page: Path) -> None:
        browser.open(page)
        browser.run(
            """const script = document.createElement('script');
            script.textContent = 'window.harmed = 3';
            document.body.append(script);
            document.body.insertAdjacentHTML('beforeend', '<p onclick="window.harmed=4">');
            document.body.lastChild.click();"""
        )
        assert browser.run("return window.harmed") is None
        assert any("Content Security Policy" in str(entry) for entry in browser.logs("browser"))
