"""The page in a real browser, offline: silent, and following slider, keys, mouse, size and theme."""

from base64 import b64encode
from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.viewing.replay import write_replay

SIZE = {"width": 1000, "height": 640}
SEEK = """time => {
  const slider = document.getElementById("time");
  slider.value = time;
  slider.dispatchEvent(new Event("input"));
}"""
TIME_AFTER = """milliseconds => new Promise(done => {
  const begin = performance.now();
  const read = () => [performance.now() - begin, Number(document.getElementById("time").value)];
  setTimeout(() => done(read()), milliseconds);
})"""
# Where the force on the base along x, #d55e00, is drawn, as shares of the picture's height from above.
HEIGHTS_OF_THE_FIRST_COLOR = """() => {
  const canvas = document.querySelectorAll(".panel canvas")[2];
  const { width, height, data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const heights = [];
  for (let i = 0; i < width * height; i++) {
    const [red, green, blue, opacity] = data.subarray(4 * i, 4 * i + 4);
    const near = Math.abs(red - 0xd5) + Math.abs(green - 0x5e) + blue < 60;
    if (near && opacity > 100) heights.push(Math.floor(i / width) / height);
  }
  return heights;
}"""
COUNT_LINES = """() => {
  const draw = CanvasRenderingContext2D.prototype.lineTo;
  window.lines = 0;
  CanvasRenderingContext2D.prototype.lineTo = function (...place) {
    window.lines++;
    draw.apply(this, place);
  };
}"""
FOCUS = """() => {
  const element = document.activeElement;
  const label = element.labels?.[0]?.textContent.trim();
  const name = element.getAttribute("aria-label") || label || element.textContent.trim();
  const shown = element.type === "radio" ? element.parentElement.querySelector(".swatch") : element;
  return [name.split("\\n")[0].trim(), getComputedStyle(shown).outlineStyle];
}"""


@pytest.fixture(scope="session")
def page_file(tmp_path_factory, make_flight, paper):
    """Expert and agent, the second one shorter."""
    agent = replace(make_flight(paper, "agent <b>", 150, 0.8), noise=np.full((150, 12), 0.05))
    flights = [make_flight(paper, "expert", 200), agent]
    return write_replay(tmp_path_factory.mktemp("replay") / "replay.html", flights, paper)


class Opened:
    """A page, and all that it said and asked for."""

    def __init__(self, page, file):
        self.page, self.said, self.requests = page, [], []
        page.on("console", lambda message: self._note(message.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.goto(file.as_uri())
        page.wait_for_function("document.getElementById('now').textContent !== ''")

    def _note(self, text):
        # Chromium's own remark on reading pictures back, where it has no graphics processor.
        if "GPU stall due to ReadPixels" not in text:
            self.said.append(text)

    @property
    def time(self):
        return float(self.page.input_value("#time"))

    def seek(self, time):
        self.page.evaluate(SEEK, time)
        self.page.wait_for_timeout(400)  # until the picture is drawn finely

    def picture(self):
        self.page.wait_for_timeout(400)
        return bytes(self.page.locator("#view").screenshot())


@pytest.fixture
def open_flights(open_page, tmp_path):
    def open_them(flights, scene, **options):
        return open_page(write_replay(tmp_path / "page.html", flights, scene), **options)

    return open_them


@pytest.fixture
def open_page(browser):
    """Opens pages; in the end none of them may have said anything."""
    opened = []

    def open_it(file, *, motion="reduce", **options):
        settings = {"viewport": SIZE, "offline": True, "reduced_motion": motion} | options
        opened.append(Opened(browser.new_context(**settings).new_page(), file))
        return opened[-1]

    yield open_it
    for each in opened:
        each.page.context.close()
        assert each.said == []


@pytest.mark.slow
def test_slider_keys_mouse_and_plots(open_page, page_file):
    opened = open_page(page_file)
    page = opened.page
    assert page.is_hidden("#missing")
    assert opened.time == 0.0  # who wants no motion gets none until asked
    first = opened.picture()
    opened.seek(1.5)
    assert page.text_content("#now") == "1.50"
    assert page.get_attribute("#time", "aria-valuetext") == "1.50 of 3.00 seconds"
    second = opened.picture()
    assert second != first
    opened.seek(0.0)
    assert opened.picture() == first  # the same moment, the same picture

    for key, steps in (("ArrowRight", 1), ("Shift+ArrowRight", 68), ("End", 200)):
        page.keyboard.press(key)
        page.wait_for_timeout(100)
        assert opened.time == pytest.approx(steps * 0.015)
    page.keyboard.press("Home")
    page.keyboard.press("]")
    assert page.input_value("#speed") == "2"
    page.keyboard.press("?")
    assert page.is_visible("#help")
    page.keyboard.press("Escape")
    assert page.is_hidden("#help")

    page.add_style_tag(content="*:focus-visible { outline: none; }")  # which would be in the picture
    before = opened.picture()
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 380, box["y"] + 260, steps=4)
    page.mouse.up()
    orbited = opened.picture()
    assert orbited != before
    page.mouse.wheel(0, -400)
    assert opened.picture() != orbited
    page.keyboard.press("r")
    assert opened.picture() == before

    area = page.locator(".panel .area").nth(2)
    place = area.bounding_box()
    # The middle of the curves, which have 44 pixels on their left and 8 on their right.
    page.mouse.click(place["x"] + 44 + 0.5 * (place["width"] - 52), place["y"] + 20)
    page.wait_for_timeout(100)
    assert opened.time == pytest.approx(1.5, abs=0.02)

    page.keyboard.press("g")
    page.wait_for_timeout(100)
    assert not page.locator(".flight input[type=checkbox]").nth(1).is_checked()
    page.keyboard.press("2")
    page.wait_for_timeout(100)
    assert "view of agent <b>" in page.get_attribute("#view", "aria-label")
    assert page.locator(".flight .name").nth(1).inner_text().startswith("agent <b>")
    assert opened.requests == [page_file.as_uri()]


@pytest.mark.slow
def test_playback_follows_real_time(open_page, page_file):
    opened = open_page(page_file, motion="no-preference")
    page = opened.page
    page.wait_for_timeout(300)
    assert opened.time > 0.0  # it has begun by itself
    page.keyboard.press("Space")
    page.wait_for_timeout(100)
    paused = opened.time
    page.wait_for_timeout(200)
    assert opened.time == paused
    page.select_option("#speed", "0.5")
    page.keyboard.press("Home")
    page.click("#play")
    elapsed = page.evaluate(TIME_AFTER, 1500)
    assert elapsed[1] == pytest.approx(0.5 * elapsed[0] / 1000, abs=0.25)
    page.keyboard.press("l")
    assert page.get_attribute("#loop", "aria-pressed") == "true"


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_size_and_theme(open_page, page_file, scheme):
    opened = open_page(page_file, color_scheme=scheme)
    page = opened.page
    assert page.get_attribute("html", "data-theme") == scheme
    side = page.locator("#plots").bounding_box()["x"]
    assert side > page.locator("#view").bounding_box()["width"]  # beside the robot
    page.set_viewport_size({"width": 390, "height": 800})
    page.wait_for_timeout(400)
    assert page.locator("#plots").bounding_box()["x"] < 20  # below it
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    canvas = page.locator("#view").evaluate("view => view.width / view.clientWidth")
    assert canvas == pytest.approx(round(canvas), abs=0.02)
    page.keyboard.press("t")
    assert page.get_attribute("html", "data-theme") == ("dark" if scheme == "light" else "light")


NO_WEBGL = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind === 'webgl' ? null : get.call(this, kind, ...rest); };"""
BROKEN_DRIVER = """const get = WebGLRenderingContext.prototype.getProgramParameter;
WebGLRenderingContext.prototype.getProgramParameter = function (program, name) {
  return name === this.LINK_STATUS ? false : get.call(this, program, name); };"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "said"), [(NO_WEBGL, []), (BROKEN_DRIVER, ["the graphics driver refuses a program"])]
)
def test_without_working_webgl_the_curves_remain(page_file, browser, script, said):
    context = browser.new_context(viewport=SIZE, offline=True, reduced_motion="reduce")
    context.add_init_script(script)
    opened = Opened(context.new_page(), page_file)
    assert opened.page.is_visible("#missing")
    assert opened.page.is_hidden("#labels") or said
    opened.seek(1.5)
    assert opened.page.text_content("#now") == "1.50"
    assert len(opened.said) == len(said)
    assert all(part in text for part, text in zip(said, opened.said, strict=True))
    context.close()


@pytest.mark.slow
def test_planar_and_diverged_flights(open_flights, make_flight):
    scene = load_scene("planar")
    flight = make_flight(scene)
    states = flight.states.copy()
    states[30:] = np.nan
    flights = [flight, replace(flight, label="lost", states=states)]
    opened = open_flights(flights, scene)
    assert "diverges after 0.435 s" in opened.page.inner_text("#flights")
    first = opened.picture()
    opened.seek(0.9)
    assert opened.picture() != first


@pytest.mark.slow
def test_a_moving_target_is_seen_to_move(open_flights, make_flight, paper):
    """Its shapes and its name; the robot is hidden, so nothing else changes the picture."""
    scene = paper.replace({"target.geometry": [{"box": [0.8, 0.6, 0.4], "color": "#ff00ff"}]})
    start = scene.target.pose.dual_quaternion
    shifts = [poses.from_axis_angle((1.0, 0.0, 0.0), 0.01 * n, (0.0, 0.0, 0.02 * n)) for n in range(61)]
    target = np.array([dual_quaternion.multiply(start, shift) for shift in shifts])
    still = np.tile(make_flight(scene).states[0], (61, 1))
    flights = [replace(make_flight(scene), states=still, target=target), make_flight(scene, "other")]
    opened = open_flights(flights, scene)
    for number in (0, 1):
        opened.page.locator(".flight input[type=checkbox]").nth(number).uncheck()
    name = opened.page.locator("#labels span").first
    first, place = opened.picture(), name.bounding_box()
    opened.seek(0.9)
    assert opened.picture() != first
    later = name.bounding_box()
    assert np.hypot(later["x"] - place["x"], later["y"] - place["y"]) > 20
    opened.seek(0.0)
    assert opened.picture() == first


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 6, 30])
def test_slider_reaches_the_end(open_flights, make_flight, paper, steps):
    """30 * 0.015 is less than 0.45, by a rounding error."""
    opened = open_flights([make_flight(paper, steps=steps)], paper)
    opened.page.locator("#time").focus()
    opened.page.evaluate(SEEK, 1e3)
    assert opened.time == pytest.approx(steps * 0.015)


@pytest.mark.slow
def test_numbers_stay_while_panels_are_drawn_anew(open_page, page_file):
    """While it plays, they change every 80 ms alone, and that time does not pass here."""
    opened = open_page(page_file, motion="no-preference")
    opened.page.evaluate(
        """() => {
          const [now, next] = [performance.now(), requestAnimationFrame];
          requestAnimationFrame = draw => next(() => draw(now));
        }"""
    )
    opened.page.click("#theme")
    opened.page.wait_for_timeout(400)
    assert "" not in opened.page.locator(".values > span > span").all_text_contents()


@pytest.mark.slow
def test_six_flights_leave_room_for_the_robot_on_a_phone(open_flights, make_flight, paper):
    flights = [make_flight(paper, f"flight {number}", 20) for number in range(6)]
    opened = open_flights(flights, paper, viewport={"width": 390, "height": 800})
    legend, view = (opened.page.locator(name).bounding_box() for name in ("#flights", "#view"))
    assert legend["height"] < 0.45 * view["height"]
    opened.page.locator(".flight").nth(5).scroll_into_view_if_needed()
    assert opened.page.locator(".flight").nth(5).is_visible()
    for panel in opened.page.locator(".panel").all()[:2]:  # six values each
        outer, values = panel.bounding_box(), panel.locator(".values").bounding_box()
        assert values["x"] + values["width"] <= outer["x"] + outer["width"]


@pytest.mark.slow
def test_what_has_the_focus_is_seen_and_has_a_name(open_page, page_file):
    opened = open_page(page_file)
    page = opened.page
    seen = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(FOCUS)
        seen.add(name)
        assert name
        assert outline == "solid", f"the focus on {name!r} is not seen"
    assert {"Reset view", "Play", "Time", "Speed", "Show expert"} <= seen
    assert any(name.startswith("expert") for name in seen)  # which one is solid


@pytest.mark.slow
def test_brackets_typed_with_altgr_change_the_speed(open_page, page_file):
    """On a German keyboard, for example; Windows reports AltGr as Ctrl and Alt."""
    opened = open_page(page_file)
    press = """modifiers => document.body.dispatchEvent(
      new KeyboardEvent("keydown", { key: "]", bubbles: true, cancelable: true, ...modifiers }))"""
    opened.page.evaluate(press, {"ctrlKey": True, "altKey": True})
    assert opened.page.input_value("#speed") == "1"
    opened.page.evaluate(press, {"ctrlKey": True, "altKey": True, "modifierAltGraph": True})
    assert opened.page.input_value("#speed") == "2"


@pytest.mark.slow
def test_eight_thrusters_look_different(open_flights, make_flight):
    scene = load_scene("thrusters")
    opened = open_flights([make_flight(scene)], scene)
    opened.page.evaluate(
        """() => {
          const stroke = CanvasRenderingContext2D.prototype.stroke;
          window.looks = [];
          CanvasRenderingContext2D.prototype.stroke = function () {
            if (this.lineWidth > 1) window.looks.push(`${this.strokeStyle} ${this.getLineDash()}`);
            stroke.apply(this);
          };
        }"""
    )
    opened.page.keyboard.press("t")  # draws all anew
    opened.page.wait_for_timeout(400)
    assert len(set(opened.page.evaluate("looks.slice(-8)"))) == 8
    marks = opened.page.locator(".panel.last .values b")
    assert [marks.nth(i).get_attribute("class") for i in range(8)] == [""] * 6 + ["dotted"] * 2


@pytest.mark.slow
def test_a_long_flight_is_drawn_fast_and_keeps_its_peaks(open_flights, make_flight, paper):
    """Of tens of thousands of steps each pixel shows many: among them one of 8 N for a single step."""
    flight = make_flight(paper, steps=20_000)
    controls = np.zeros_like(flight.controls)
    controls[10_000, 0] = 8.0
    opened = open_flights([replace(flight, controls=controls)], paper, color_scheme="light")
    heights = opened.page.evaluate(HEIGHTS_OF_THE_FIRST_COLOR)
    assert min(heights) < 0.35
    assert max(heights) > 0.6
    opened.page.evaluate(COUNT_LINES)
    opened.page.keyboard.press("t")  # draws all anew
    opened.page.wait_for_timeout(400)
    assert 5_000 < opened.page.evaluate("lines") < 100_000  # of 14 curves; one by one they would be 520,000


@pytest.mark.slow
def test_violated_constraints_are_red_and_can_be_switched_off(open_flights, make_flight, paper):
    """A star tracker on the base looks into the sun all along; no joint turns too fast."""
    sun = {
        "name": "sun",
        "kind": "keep_out_direction",
        "axis": {"frame": "base", "direction": [1, 0, 0]},
        "direction": {"frame": "inertial", "direction": [1, 0, 0]},
        "angle_deg": 20,
    }
    limits = {"name": "limits", "kind": "joint_limits", "rate": 1.0}
    scene = paper.replace(constraints=[sun, limits])
    opened = open_flights([make_flight(scene)], scene)
    labels = "[...document.querySelectorAll('#constraints label')].map(l => [l.textContent, l.className])"
    assert opened.page.evaluate(labels) == [["sun", "broken"], ["limits", ""]]
    boxes = opened.page.locator("#constraints input")
    assert boxes.count() == 1  # of shapes alone
    seen = opened.picture()
    boxes.first.uncheck()
    assert opened.picture() != seen
    assert open_flights([make_flight(paper)], paper).page.is_hidden("#constraints")


@pytest.mark.slow
def test_the_list_of_scenes_and_the_address_choose_one(open_page, make_flight, paper, tmp_path):
    planar = load_scene("planar").replace(name="a plane: x & y")
    file = write_replay(tmp_path / "page.html", [make_flight(paper)], paper, ([make_flight(planar)], planar))
    opened = open_page(file)
    page = opened.page
    assert page.locator("#scenes option").all_text_contents() == ["paper", planar.name]
    assert page.input_value("#scenes") == "paper"
    assert page.is_hidden("#scene-name")
    page.keyboard.press("t")
    theme = page.get_attribute("html", "data-theme")
    panels = page.locator(".panel").count()
    with page.expect_navigation(wait_until="load"):
        page.select_option("#scenes", planar.name)
    page.locator(".panel").first.wait_for()
    assert page.inner_text("#scene-description") == planar.description
    assert page.locator(".panel").count() != panels
    assert page.get_attribute("html", "data-theme") == theme  # stays as chosen
    with page.expect_event("load"):
        page.go_back()
    page.locator(".panel").first.wait_for()
    assert page.input_value("#scenes") == "paper"
    assert {url.partition("#")[0] for url in opened.requests} == {file.as_uri()}
    alone = write_replay(tmp_path / "one.html", [make_flight(paper)], paper)
    assert open_page(alone).page.is_hidden("#scenes")


PLAYED = """data => new Promise(done => {
  const video = document.createElement("video");
  video.onerror = () => done([0, 0, 0, video.error.message]);
  video.onloadedmetadata = () => {
    video.onseeked = () => {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
      const context = canvas.getContext("2d");
      context.drawImage(video, 0, 0);
      const colors = new Set(context.getImageData(0, 0, canvas.width, canvas.height).data);
      done([video.duration, video.videoWidth, video.videoHeight, colors.size]);
    };
    video.currentTime = 0.5 * video.duration;
  };
  video.src = data;
})"""


@pytest.mark.slow
def test_a_flight_is_recorded_as_a_video(open_page, page_file, browser):
    """From its beginning to its end, or until it is paused; the browser plays what it recorded."""
    opened = open_page(page_file, accept_downloads=True)
    page = opened.page
    if page.is_hidden("#record"):
        pytest.skip("this browser records no canvas")
    opened.seek(2.0)
    page.keyboard.press("l")  # a loop would have no end
    with page.expect_download() as recorded:
        page.keyboard.press("v")
        page.locator("#record[aria-pressed=true]").wait_for()
        page.set_viewport_size({"width": 900, "height": 600})  # the video keeps its size
    assert opened.time == pytest.approx(3.0)
    assert page.get_attribute("#loop", "aria-pressed") == "false"
    page.locator("#record[aria-pressed=false]").wait_for()
    file = recorded.value
    kind = file.suggested_filename.rpartition(".")[2]
    assert file.suggested_filename == f"paper-expert.{kind}"
    content = file.path().read_bytes()
    assert len(content) > 20_000
    assert (content[4:8] == b"ftyp") if kind == "mp4" else content.startswith(b"\x1a\x45\xdf\xa3")

    player = browser.new_page()
    address = f"data:video/{kind};base64,{b64encode(content).decode()}"
    duration, width, height, colors = player.evaluate(PLAYED, address)
    player.close()
    assert duration is None or duration > 2.5  # from the beginning; unknown in a WebM
    assert (width % 2, height % 2) == (0, 0)
    assert width > 300
    assert colors > 50

    page.select_option("#speed", "0.1")
    with page.expect_download() as recorded:
        page.click("#record")
        while opened.time < 0.05:
            page.wait_for_timeout(50)
        page.click("#record")  # ends it
    assert opened.time < 2.9
    assert recorded.value.path().stat().st_size > 1000
    assert opened.requests == [page_file.as_uri()]
